"""The invariants that every journal must satisfy: `overfly log check`."""
