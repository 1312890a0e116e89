"""The flight recorder: what is logged, in which schema, and how it is written and read back."""
