"""For trials: a witness that takes down a hash of all that a UAV decides by, so that two missions can be compared."""

from __future__ import annotations

from hashlib import blake2b
from typing import Any

from actors.planners import Decider, Sight
from tmc.kernel.observation import Observer
from tmc.record.schemas import Witness as Testimony
from tmc.wire.messages import Record

BY_CHANCE = 0
"""Stands for the hash where exploration chose, and the UAV looked at nothing."""


def digest(observer: Observer, sight: Sight) -> int:
    """BLAKE2b of 8 bytes, little-endian, over o_i(t) (float32, eq. 12) and the ids of the allowed actions."""
    image = observer.observe(sight.cell, sight.peers, sight.u)
    return int.from_bytes(blake2b(image.tobytes() + bytes(sight.allowed), digest_size=8).digest(), "little")


class Witness:
    """Watches the decider of one UAV. What it took down is given out a record at a time."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self._hashes: dict[int, int] = {}

    def watch(self, decider: Decider) -> Decider:
        """The same decider, watched."""
        return _Watched(decider, self)

    def see(self, sight: Sight) -> None:
        """The UAV is about to decide by this."""
        self._hashes[sight.tick] = digest(self._observer, sight)

    def testify(self, record: Record) -> Any:
        """The overfly.Witness to the moves of a record; what was taken down is forgotten."""
        moves = range(max(record.first, 1), record.tick + 1)
        hashes = [self._hashes.get(tick - 1, BY_CHANCE) for tick in moves]
        self._hashes.clear()
        return Testimony(
            uav=record.uav, episode=record.episode, first=record.first, tick=record.tick, hashes=hashes
        )  # fmt: skip


class _Watched:
    def __init__(self, decider: Decider, witness: Witness) -> None:
        self._decider, self._witness = decider, witness

    def choose(self, sight: Sight) -> int:
        self._witness.see(sight)
        return self._decider.choose(sight)
