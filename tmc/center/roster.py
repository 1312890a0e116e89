"""The roster: the clients that take part in a mission as the TMC knows them, and the outbox for them."""

from __future__ import annotations

from dataclasses import dataclass, field

from tmc.center import entries
from tmc.wire import messages as m

LEARNER = "learner"


def uav_name(i: int) -> str:
    """Return the address of UAV i's process."""
    return f"uav-{i:03d}"


@dataclass
class Outbox:
    """Hold what the core wants done: messages to send, entries to journal, notes to log. The service empties it."""

    sends: list[tuple[str, m.Message]] = field(default_factory=list)
    entries: list[entries.JournalEntry] = field(default_factory=list)
    notes: list[tuple[str, str]] = field(default_factory=list)

    def take_sends(self) -> list[tuple[str, m.Message]]:
        """Remove and return the messages."""
        taken, self.sends = self.sends, []
        return taken

    def take_entries(self) -> Outbox:
        """Remove and return the entries and notes."""
        taken = Outbox([], self.entries, self.notes)
        self.entries, self.notes = [], []
        return taken

    def take(self) -> Outbox:
        """Remove and return everything."""
        taken = Outbox(self.sends, self.entries, self.notes)
        self.sends, self.entries, self.notes = [], [], []
        return taken


@dataclass
class Member:
    """Hold what the TMC knows of one UAV's process.

    `incarnation`: of the process, -1 if there is none; `former`: the incarnations before it; `heard`: when it was last
    heard (s); `sequence`: the number of its next record; `durable`: its records below this number are committed;
    `policy`: the version that it was told to fly. A new process flies that version too, since peers may have seen where
    the last one flew. `answer`: the last Map sent to it; `named`: True once its present silence was logged.
    """

    incarnation: int = -1
    former: set[int] = field(default_factory=set)
    heard: float = 0.0
    sequence: int = 0
    durable: int = 0
    policy: int = 0
    answer: m.Map | None = None
    named: bool = False

    def heard_from(self, incarnation: int, now: float) -> bool:
        """Note that a process was heard at `now` (s); return True if it replaces another one."""
        new = self.incarnation not in {-1, incarnation}
        if new:
            self.former.add(self.incarnation)
        self.incarnation, self.heard, self.named = incarnation, now, False
        return new


def away(members: list[Member]) -> list[int]:
    """Return the UAVs without a process."""
    return [i for i, member in enumerate(members) if member.incarnation < 0]


def name_some(names: list[str]) -> str:
    """Return the first ten names, and how many more there are, as text."""
    return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")


def silent(members: list[Member], now: float, patience: float) -> list[int]:
    """Return the UAVs that have not been heard for `patience` seconds, each once per silence."""
    found = [i for i in long_silent(members, now, patience) if not members[i].named]
    for i in found:
        members[i].named = True
    return found


def long_silent(members: list[Member], now: float, patience: float) -> list[int]:
    """Return the UAVs with a process that has not been heard for `patience` seconds."""
    return [i for i, m in enumerate(members) if m.incarnation >= 0 and now - m.heard > patience]


def excuse(members: list[Member], pause: float, now: float) -> None:
    """Do not count the `pause` seconds before `now` as silence: no client could be heard then."""
    for member in members:
        member.heard = min(member.heard + pause, now)


Problem = tuple[str, str] | None
"""Error code and sentence, or None when all is well."""


def hello_problem(members: list[Member], sender: str, hello: m.Hello) -> Problem:
    """Return why a UAV cannot say hello: the name is not its own, or a newer incarnation has replaced it."""
    if not 0 <= hello.uav < len(members) or sender != uav_name(hello.uav):
        return "refused", f"{sender} is not the name of UAV {hello.uav} in a team of {len(members)}"
    if hello.incarnation in members[hello.uav].former:
        return "fenced", f"a newer process flies {sender}: leave"
    return None


def record_problem(members: list[Member], sender: str, record: m.Record) -> Problem:
    """Return why a UAV cannot ship a record: it is not its own, not known here, or of an older incarnation."""
    if not 0 <= record.uav < len(members) or sender != uav_name(record.uav):
        return "refused", f"{sender} cannot ship a record of UAV {record.uav}"
    if members[record.uav].incarnation < 0:
        return "state", f"{sender} is not known here: say hello first"
    if record.incarnation in members[record.uav].former:
        return "fenced", f"a newer process flies {sender}: leave"
    if record.incarnation != members[record.uav].incarnation:  # it said hello to an earlier incarnation of the TMC
        return "state", f"this process of {sender} is not known here: say hello first"
    return None
