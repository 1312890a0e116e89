"""What `overfly bench` measures: one module a bench, with `add_arguments(parser)` and `measure(args)`."""
