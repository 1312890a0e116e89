"""Records that arrive before their turn wait here until the exchange before them has been held.

Each UAV resends at once all that a restarted TMC had not committed. The journal, and the maps that the replay keeps,
must get these records in the order in which they were flown.
"""

from __future__ import annotations

from collections.abc import Sequence

from tmc.wire.messages import Record

MAX_BUFFERED_RECORDS = 256
"""Records kept per UAV; the UAV resends what does not fit."""


class ReorderBuffer:
    """Hold the next records of each UAV, in their order, until they can be accepted."""

    def __init__(self) -> None:
        self._kept: dict[int, list[Record]] = {}

    def count(self, uav: int) -> int:
        """Return how many records of a UAV are kept."""
        return len(self._kept.get(uav, ()))

    def keep(self, record: Record) -> None:
        """Keep the record that follows the UAV's kept ones, if there is room."""
        kept = self._kept.setdefault(record.uav, [])
        if len(kept) < MAX_BUFFERED_RECORDS:
            kept.append(record)

    def drop(self, uav: int) -> None:
        """Forget the records of a UAV: another process flies it now, or none."""
        self._kept.pop(uav, None)

    def pop_ready(self, next_exchange: int, reported: Sequence[int]) -> Record | None:
        """Remove and return a record whose turn has come, or never will; None when there is none.

        `next_exchange`: the tick of the next exchange; `reported`: the last tick that each UAV has reported.
        """
        for uav, kept in self._kept.items():
            if kept[0].first <= next_exchange or kept[0].first != reported[uav] + 1:
                record = kept.pop(0)
                if not kept:
                    del self._kept[uav]
                return record
        return None
