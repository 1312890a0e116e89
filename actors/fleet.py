"""The lock-step fleet: the same pilots in one process.

It is the reference for a team of processes, and what evaluates policies.
"""

from __future__ import annotations

from typing import Protocol

from actors.airspace import Waiting
from actors.pilot import Phase, Pilot
from tmc.wire.messages import Begin, Lost, Map, Message, Policy


class Exchange(Protocol):
    """The TMC's side: takes one UAV's message and returns its messages to any of them, as (uav, message)."""

    def __call__(self, uav: int, message: Message) -> list[tuple[int, Message]]: ...


class Fleet:
    """N pilots that fly in turn, each as far as it can."""

    def __init__(self, pilots: list[Pilot], exchange: Exchange) -> None:
        self.pilots, self._exchange = pilots, exchange

    def deliver(self, uav: int, message: Message) -> None:
        """Deliver a message to a pilot, and the pilot's answer to the TMC."""
        pilot, answer = self.pilots[uav], None
        if isinstance(message, Begin):
            answer = pilot.on_begin(message)
        elif isinstance(message, Map):
            answer = pilot.on_map(message)
        elif isinstance(message, Policy):
            pilot.on_policy(message)
        elif isinstance(message, Lost):
            pilot.on_lost(message)
        if answer is not None:
            self._send(uav, answer)

    def _send(self, uav: int, message: Message) -> None:
        for i, reply in self._exchange(uav, message):
            self.deliver(i, reply)

    def step(self) -> bool:
        """Let every pilot fly as far as it can; return False when none could."""
        moved = False
        for pilot in self.pilots:
            before = (pilot.t, pilot.phase)
            try:
                record = pilot.advance()
            except Waiting:
                record = None
            if record is not None:
                self._send(pilot.uav, record)
            moved |= record is not None or before != (pilot.t, pilot.phase)
        return moved

    @property
    def idle(self) -> bool:
        """Whether no pilot has an episode to fly."""
        return all(pilot.phase is Phase.IDLE for pilot in self.pilots)
