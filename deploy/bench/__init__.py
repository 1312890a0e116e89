"""The benches of `overfly bench`: one module per bench, with `add_arguments(parser)` and `measure(args)`."""
