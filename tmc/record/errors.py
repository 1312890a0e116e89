"""The errors of the flight recorder."""

from tmc.kernel.errors import OverflyError


class RecordError(OverflyError):
    """A log cannot be written or read. The text is one sentence with the cause and the fix."""


class NoLogError(RecordError):
    """The given file or folder is not a log, or holds none."""
