"""The one error of the flight recorder."""

import errno
from pathlib import Path


class RecordError(Exception):
    """A log that cannot be written or read: one sentence with the mend."""


def unwritable(path: Path, error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return f"the disk that holds {path} is full: free some space and resume; what was flushed stays readable"
    return f"{path} cannot be written ({error.strerror}): make its folder exist and writable, or choose another one"
