"""The invariant of the TMC's state: replaying the journal gives the maps and the replay memory that it held."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tmc.analysis.invariants.result import InvariantResult, Violation
from tmc.center import recovery
from tmc.center.entries import JournalEntry
from tmc.center.station import Station
from tmc.kernel.world import World
from tmc.record import overfly_pb2
from tmc.record.errors import RecordError
from tmc.record.reader import Log

STATE = ("state", "the TMC's maps and replay memory with a replay of the journal")
"""Name, and what is compared."""
_DIGESTS = {"map": "the maps differ", "replay": "the replay memory differs",
            "transitions": "the number of transitions differs"}  # fmt: skip


def states(world: World, log: Log, show: Callable[[str, float], None]) -> InvariantResult:
    """Check the digests at the end of each episode against those of a station that replays the journal."""
    replayed: dict[int, dict[str, Any]] = {}

    def watch(entries: list[JournalEntry]) -> None:
        for entry in entries:
            if entry.topic == "/tmc/state":
                number = entry.values["episode"]
                replayed[number] = entry.values
                show(f"replayed episode {number}", number / world.config.training.episodes)

    violation = None
    try:
        recovery.play(Station(world, "check", learning=False), log.raw(), log.path.parent, 0.0, watch=watch)
    except RecordError as error:
        violation = Violation(None, None, None, str(error))
    logged = [*log.messages(overfly_pb2.State)]
    faults = (Violation(s.episode, None, None, what) for s in logged if s.episode in replayed
              for name, what in _DIGESTS.items() if getattr(s, name) != replayed[s.episode][name])  # fmt: skip
    return InvariantResult(len(_DIGESTS) * sum(s.episode in replayed for s in logged), next(faults, violation))
