"""For trials: what a UAV logs so that its flight can be compared with the TMC's journal.

`ObservationHasher` logs a hash of each observation that the UAV decides by, so that two missions can be compared.
`AckLog` logs which of its flight records the TMC has acknowledged, so that one missing from the journal is found.
"""

from __future__ import annotations

import os
from hashlib import blake2b
from pathlib import Path

from actors.planners import Controller, LocalState, QController
from tmc.kernel.observation import ObservationBuilder
from tmc.record.builders import record_digest
from tmc.record.overfly_pb2 import ObservationHashes
from tmc.record.run_folder import RunFolder
from tmc.wire.messages import Record

EXPLORED = 0
"""Stands for the hash where exploration chose the action, without an observation."""


def digest(observer: ObservationBuilder, state: LocalState) -> int:
    """Return the 8-byte BLAKE2b, little-endian, of o_i(t) (float32, eq. 12) and the ids of the allowed actions."""
    image = observer.observe(state.cell, state.peers, state.u)
    return int.from_bytes(blake2b(image.tobytes() + bytes(state.allowed), digest_size=8).digest(), "little")


class ObservationHasher:
    """Hashes what the controller of one UAV decides by, and gives the hashes out record by record."""

    def __init__(self, observer: ObservationBuilder) -> None:
        self._observer = observer
        self._hashes: dict[int, int] = {}

    def watch(self, controller: Controller) -> Controller:
        """Return a controller that hashes each state and then chooses as `controller` does."""
        return _Watched(controller, self)

    def add(self, state: LocalState) -> None:
        """Hash a state that the UAV is about to decide by."""
        self._hashes[state.tick] = digest(self._observer, state)

    def hashes_for(self, record: Record) -> ObservationHashes:
        """Return the overfly.ObservationHashes for the moves of a record, and forget all hashes."""
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
        self._hasher.add(state)
        return self._controller.choose(state)

    def q_of(self, state: LocalState, action: int) -> tuple[float, float]:
        assert isinstance(self._controller, QController)
        return self._controller.q_of(state, action)


class AckLog:
    """The file `acks/uav-<id>.txt`: a line "sequence digest" for each record that was acknowledged."""

    def __init__(self, out: Path, uav: int) -> None:
        path = RunFolder(out).acks_of(f"uav-{uav:03d}")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def append(self, record: Record) -> None:
        """Append an acknowledged record, in one write, so that a kill never leaves half a line."""
        os.write(self._file, f"{record.sequence} {record_digest(record)}\n".encode())
