"""For trials: what a UAV takes down apart, to be held against the log of the TMC.

A witness takes down a hash of all that the UAV decides by, so that two missions can be compared. An oath takes down
which of its flight records the TMC has acknowledged, so that one that is not in the journal is found out.
"""

from __future__ import annotations

import os
from hashlib import blake2b
from pathlib import Path
from typing import Any

from actors.planners import Decider, Sight, Valued
from tmc.kernel.observation import Observer
from tmc.record.builders import record_digest
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

    def worth(self, sight: Sight, action: int) -> tuple[float, float]:
        assert isinstance(self._decider, Valued)
        return self._decider.worth(sight, action)


class Oath:
    """A file of its own, in which each line is the number and the digest of a record that was acknowledged."""

    def __init__(self, out: Path, uav: int) -> None:
        folder = out / "oaths"
        folder.mkdir(parents=True, exist_ok=True)
        self._file = os.open(folder / f"uav-{uav:03d}.txt", os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def swear(self, record: Record) -> None:
        """The TMC has acknowledged this record; in one write, so that a kill leaves no half of a line."""
        os.write(self._file, f"{record.sequence} {record_digest(record)}\n".encode())
