"""For trials: what a UAV takes down apart, to be held against the log of the TMC.

A hasher takes down a hash of all that the UAV decides by, so that two missions can be compared. An oath takes down
which of its flight records the TMC has acknowledged, so that one that is not in the journal is found out.
"""

from __future__ import annotations

import os
from hashlib import blake2b
from pathlib import Path
from typing import Any

from actors.planners import Controller, LocalState, QController
from tmc.kernel.observation import ObservationBuilder
from tmc.record.builders import record_digest
from tmc.record.run_folder import RunFolder
from tmc.record.schemas import ObservationHashes
from tmc.wire.messages import Record

EXPLORED = 0
"""Stands for the hash where exploration chose, and the UAV looked at nothing."""


def digest(observer: ObservationBuilder, state: LocalState) -> int:
    """BLAKE2b of 8 bytes, little-endian, over o_i(t) (float32, eq. 12) and the ids of the allowed actions."""
    image = observer.observe(state.cell, state.peers, state.u)
    return int.from_bytes(blake2b(image.tobytes() + bytes(state.allowed), digest_size=8).digest(), "little")


class ObservationHasher:
    """Watches the controller of one UAV. What it took down is given out a record at a time."""

    def __init__(self, observer: ObservationBuilder) -> None:
        self._observer = observer
        self._hashes: dict[int, int] = {}

    def watch(self, controller: Controller) -> Controller:
        """The same controller, watched."""
        return _Watched(controller, self)

    def see(self, state: LocalState) -> None:
        """The UAV is about to decide by this."""
        self._hashes[state.tick] = digest(self._observer, state)

    def hashes_for(self, record: Record) -> Any:
        """The overfly.ObservationHashes to the moves of a record; what was taken down is forgotten."""
        moves = range(max(record.first, 1), record.tick + 1)
        hashes = [self._hashes.get(tick - 1, EXPLORED) for tick in moves]
        self._hashes.clear()
        return ObservationHashes(
            uav=record.uav, episode=record.episode, first=record.first, tick=record.tick, hashes=hashes
        )  # fmt: skip


class _Watched:
    def __init__(self, controller: Controller, hasher: ObservationHasher) -> None:
        self._controller, self._hasher = controller, hasher

    def choose(self, state: LocalState) -> int:
        self._hasher.see(state)
        return self._controller.choose(state)

    def q_of(self, state: LocalState, action: int) -> tuple[float, float]:
        assert isinstance(self._controller, QController)
        return self._controller.q_of(state, action)


class AckLog:
    """A file of its own, in which each line is the number and the digest of a record that was acknowledged."""

    def __init__(self, out: Path, uav: int) -> None:
        path = RunFolder(out).acks_of(f"uav-{uav:03d}")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def append(self, record: Record) -> None:
        """The TMC has acknowledged this record; in one write, so that a kill leaves no half of a line."""
        os.write(self._file, f"{record.sequence} {record_digest(record)}\n".encode())
