"""The lock-step fleet: the same pilots in one process. The reference for a team of processes, and the evaluator."""

from __future__ import annotations

from typing import Protocol

from actors.airspace import Waiting
from actors.pilot import Phase, Pilot
from tmc.wire.messages import Begin, Lost, Map, Message, Policy


class Exchange(Protocol):
    """The other side of the radio: takes one UAV's message and returns what it has for all, as (uav, message)."""

    def __call__(self, uav: int, message: Message) -> list[tuple[int, Message]]: ...


class Fleet:
    """N pilots who fly in turn, each as far as it can."""

    def __init__(self, pilots: list[Pilot], exchange: Exchange) -> None:
        self.pilots, self._exchange = pilots, exchange

    def deliver(self, uav: int, message: Message) -> None:
        """Hand a message to a pilot, and its answer to the TMC."""
        pilot, answer = self.pilots[uav], None
        if isinstance(message, Begin):
            answer = pilot.begin(message)
        elif isinstance(message, Map):
            answer = pilot.on_map(message)
        elif isinstance(message, Policy):
            pilot.on_policy(message)
        elif isinstance(message, Lost):
            pilot.on_lost(message)
        if answer is not None:
            self._say(uav, answer)

    def _say(self, uav: int, message: Message) -> None:
        for i, reply in self._exchange(uav, message):
            self.deliver(i, reply)

    def step(self) -> bool:
        """Let every pilot fly as far as it can; False when none could move at all."""
        moved = False
        for pilot in self.pilots:
            before = (pilot.t, pilot.phase)
            try:
                record = pilot.advance()
            except Waiting:
                record = None
            if record is not None:
                self._say(pilot.uav, record)
            moved |= record is not None or before != (pilot.t, pilot.phase)
        return moved

    @property
    def idle(self) -> bool:
        """True when no pilot has an episode to fly."""
        return all(pilot.phase is Phase.IDLE for pilot in self.pilots)
