"""The one error of the flight recorder."""


class RecordError(Exception):
    """A log that cannot be written or read: one sentence with the mend."""
