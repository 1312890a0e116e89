"""Makes the MCAP writer of every file that we write, so that all of them are of one make."""

from __future__ import annotations

from typing import IO

from mcap.writer import CompressionType, Writer


def mcap_writer(file: IO[bytes], chunk: int) -> Writer:
    """Write MCAP to an open file: zstd, CRCs over everything, in chunks of `chunk` bytes before compression.

    The summary has no offsets of its groups, which the format leaves to the writer: mcap gives one to every kind of
    record, those that the file does not hold included, and checkers of the format report these as errors.
    """
    return Writer(file, chunk, CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True, use_summary_offsets=False)
