"""The base of all errors that are meant for the user."""

from __future__ import annotations


class OverflyError(Exception):
    """What went wrong, as one sentence with the cause and the fix. The command prints it, and Python code catches it
    as `overfly.Error`."""
