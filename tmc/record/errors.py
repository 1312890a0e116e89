"""The errors of the flight recorder."""

from tmc.kernel.errors import OverflyError


class RecordError(OverflyError):
    """A log that cannot be written or read: one sentence with the mend."""


class NoLogError(RecordError):
    """What was given as a log, or as the folder of logs, is not one: there is nothing to read in it."""
