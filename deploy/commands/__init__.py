"""The subcommands of `overfly`, one module each."""
