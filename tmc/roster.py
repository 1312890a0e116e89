"""Who takes part in a mission, as the TMC knows them, and what the TMC has for them."""

from __future__ import annotations

from dataclasses import dataclass, field

from tmc import entries
from tmc.wire import messages as m

LEARNER = "learner"


def uav_name(i: int) -> str:
    """The address of UAV i's process."""
    return f"uav-{i:03d}"


@dataclass
class Outbox:
    """What the core wants done: messages to send, entries to journal, notes for the log. The service empties it."""

    sends: list[tuple[str, m.Message]] = field(default_factory=list)
    entries: list[entries.Entry] = field(default_factory=list)
    notes: list[tuple[str, str]] = field(default_factory=list)

    def take(self) -> Outbox:
        """All of it; this outbox is empty afterwards."""
        taken = Outbox(self.sends, self.entries, self.notes)
        self.sends, self.entries, self.notes = [], [], []
        return taken


@dataclass
class Member:
    """A UAV on the roster: its process's life, the lives before it, when it was last heard of, its last answer."""

    life: int = -1
    past: set[int] = field(default_factory=set)
    heard: float = 0.0
    sequence: int = 0
    answer: m.Map | None = None
    named: bool = False


def name_some(names: list[str]) -> str:
    """The first ten names, and how many more there are."""
    return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")


def silent(members: list[Member], waited_for: list[str], now: float, patience: float) -> list[str]:
    """Those of the UAVs waited for who were not heard of for `patience` seconds, each named once in its silence."""
    found = []
    for name in waited_for:
        member = members[int(name.removeprefix("uav-"))]
        if not member.named and member.heard and now - member.heard > patience:
            member.named = True
            found.append(name)
    return found
