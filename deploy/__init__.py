"""The composition root: the command, the presets, and the supervisor. The only package that knows all others."""
