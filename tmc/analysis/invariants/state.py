"""The invariant of the TMC's state: who plays the journal gets the maps and the replay memory that it held."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tmc.analysis.invariants.result import InvariantResult, Violation
from tmc.center import recovery
from tmc.center.entries import JournalEntry
from tmc.center.station import Station
from tmc.kernel.world import World
from tmc.record.errors import RecordError
from tmc.record.reader import Log

STATE = ("state", "the TMC's maps and replay memory with the journal played anew")
"""Name, and what is compared."""
_DIGESTS = {"map": "the maps are others", "replay": "the replay memory is another",
            "transitions": "it holds another number of transitions"}  # fmt: skip


def states(world: World, log: Log, show: Callable[[str, float], None]) -> InvariantResult:
    """At the end of each episode the digests in the journal are those that playing it gives."""
    made: dict[int, dict[str, Any]] = {}

    def watch(entries: list[JournalEntry]) -> None:
        for entry in entries:
            if entry.topic == "/tmc/state":
                number = entry.values["episode"]
                made[number] = entry.values
                show(f"played episode {number}", number / world.config.training.episodes)

    violation = None
    try:
        recovery.play(Station(world, "check", learning=False), log.raw(), log.path.parent, 0.0, watch=watch)
    except RecordError as error:
        violation = Violation(None, None, None, str(error))
    told = [entry.message for entry in log.entries(("/tmc/state",))]
    faults = (Violation(s.episode, None, None, what) for s in told if s.episode in made
              for name, what in _DIGESTS.items() if getattr(s, name) != made[s.episode][name])  # fmt: skip
    return InvariantResult(len(_DIGESTS) * sum(s.episode in made for s in told), next(faults, violation))
