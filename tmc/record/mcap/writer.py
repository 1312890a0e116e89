"""Make the MCAP writer of every file that Overfly writes, so that all have the same form."""

from __future__ import annotations

from typing import IO

from mcap.writer import CompressionType, Writer


def mcap_writer(file: IO[bytes], chunk_bytes: int) -> Writer:
    """Write MCAP to an open file: zstd, CRCs over everything, in chunks of `chunk_bytes` before compression.

    The summary has no offsets of its groups; the format makes them optional. mcap writes one for every kind of record,
    including those that the file does not hold, and checkers of the format report these as errors.
    """
    return Writer(
        file, chunk_bytes, CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True, use_summary_offsets=False
    )
