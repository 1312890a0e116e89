"""Records that are here before their turn: what a UAV flew after an exchange waits until that exchange has been held.

A TMC that was started again is told all that its last incarnation had not committed, by each UAV at once. The journal,
and the maps that the replay keeps, must have it in the order in which it was flown.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tmc.center.episode import EpisodeState, RefusedError
from tmc.center.roster import uav_name
from tmc.wire.messages import Record

if TYPE_CHECKING:
    from tmc.center.station import Station

MAX_BUFFERED_RECORDS = 256
"""Records of a UAV that are kept; it says the others again."""


class ReorderBuffer:
    """The next records of each UAV, in their order, until they can be accepted."""

    def __init__(self) -> None:
        self._kept: dict[int, list[Record]] = {}

    def count(self, uav: int) -> int:
        """How many of a UAV's records are kept."""
        return len(self._kept.get(uav, ()))

    def keep(self, record: Record) -> None:
        """Keep the record of a UAV that follows those which are kept, if there is room."""
        kept = self._kept.setdefault(record.uav, [])
        if len(kept) < MAX_BUFFERED_RECORDS:
            kept.append(record)

    def drop(self, uav: int) -> None:
        """Forget what is kept of a UAV: another process flies it now, or none."""
        self._kept.pop(uav, None)

    def accept(self, station: Station, episode: EpisodeState) -> None:
        """Give the station every record whose turn it is, and reject those that cannot be true."""
        while station.episode is episode and (record := self._ready(episode)) is not None:
            try:
                station.accept(episode, record)
            except RefusedError as refused:
                self.drop(record.uav)
                station.reject(uav_name(record.uav), "refused", str(refused))

    def _ready(self, episode: EpisodeState) -> Record | None:
        """Take out a record whose turn it is, or will never be."""
        for uav, kept in self._kept.items():
            if kept[0].first <= episode.next_exchange or kept[0].first != episode.reported[uav] + 1:
                record = kept.pop(0)
                if not kept:
                    del self._kept[uav]
                return record
        return None
