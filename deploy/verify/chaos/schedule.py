"""The faults that are still to come, and what came of those before: it lasts for several missions, if need be."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from deploy.run.progress import clock
from deploy.verify.chaos.checker import Number, Snapshot
from deploy.verify.chaos.faults import POWER, Fault
from tmc.wire import messages as m


@dataclass
class Growth:
    """By how much ticks and updates have grown since the first status was taken."""

    ticks: int = 0
    updates: int = 0
    last: m.Status | None = None

    def take(self, status: m.Status | None) -> None:
        """A new status. A learner that starts again from its checkpoint has fewer updates: that takes nothing away."""
        if status is not None and self.last is not None:
            self.ticks += max(0, status.ticks - self.last.ticks)
            self.updates += max(0, status.updates - self.last.updates)
        self.last = status or self.last


class FaultSchedule:
    """`say` shows the progress, `diary` is the file in which everything is noted with its time.

    `until_loss`: it is over as soon as a loss was seen.
    """

    def __init__(
        self, faults: Iterable[Fault], say: Callable[[str], None], diary: Path, *, until_loss: bool = False
    ) -> None:
        self._left, self.say, self._diary, self._until_loss = deque(faults), say, diary, until_loss
        self.asked = sum(fault.kills for fault in self._left)
        self.done: list[Fault] = []
        self.kills: Counter[str] = Counter()
        self.backs: Counter[str] = Counter()
        self.recoveries: defaultdict[str, list[float]] = defaultdict(list)
        self.crashes: list[str] = []
        self.failures: list[str] = []
        self.snapshots: list[Snapshot] = []
        self.lost: set[Number] = set()
        """Records of this mission that were acknowledged and did not survive a kill."""
        self.cut_off = 0
        self.power_lost: float | None = None
        """When the power went, until the mission goes on."""
        self.growth = Growth()
        self.went_on = False
        self._start = time.monotonic()

    @property
    def next(self) -> Fault | None:
        """The next fault, None when the schedule is over."""
        return self._left[0] if self._left else None

    @property
    def last(self) -> Fault:
        """The fault before."""
        return self.done[-1]

    def started(self) -> None:
        """The next fault falls now."""
        self.done.append(fault := self._left.popleft())
        self.write(f"{fault.kind} {' '.join(fault.targets)} ({fault.seconds:.2f} s)")

    def later(self, fault: Fault) -> None:
        """What is left of a fault to which a mission's end came first, for the next mission."""
        if fault.targets:
            self._left.appendleft(fault)

    def count(self, kind: str) -> int:
        """Blows of a kind so far."""
        return sum(fault.kind == kind for fault in self.done)

    def back(self, who: str, seconds: float | None) -> None:
        """A process that was killed is back and works, so long after; None where that could not be measured."""
        self.backs[who] += 1
        if seconds is not None:
            self.recoveries[who].append(seconds)
            self.write(f"{who} is back after {seconds:.2f} s")

    def power_restored(self, *, measured: bool) -> None:
        """If the power was gone: the mission goes on, or has come to its end."""
        if self.power_lost is not None:
            self.back(POWER, time.monotonic() - self.power_lost if measured else None)
            self.power_lost = None

    def check_snapshots(self) -> None:
        """Look for losses in the journals that kills have left."""
        while self.snapshots:
            lost = self.snapshots.pop().lost()
            self.lost |= lost
            if lost:
                self._left = deque() if self._until_loss else self._left
                self.write(f"{len(lost)} acknowledged records did not survive: {sorted(lost)[:10]}")

    def finish(self, seconds: float) -> None:
        """The schedule is over, and the mission goes on."""
        self.went_on = True
        self.write(f"the mission goes on after the last fault, seen after {seconds:.2f} s")

    def note(self, text: str) -> None:
        """What the supervisor says: a process that failed by itself is remembered."""
        if "with exit code" in text or "did not leave" in text:
            self.crashes.append(text)
        self.write(text)

    def write(self, text: str) -> None:
        """A line of the diary."""
        with self._diary.open("a", encoding="utf-8") as file:
            file.write(f"{time.monotonic() - self._start:8.2f} {text}\n")

    def show(self) -> None:
        """Progress."""
        killed, spent = sum(self.kills.values()), time.monotonic() - self._start
        status = self.growth.last
        where = f" · episode {status.episode} tick {status.tick} · {status.updates:,} updates" if status else ""
        left = f" · {clock(spent / killed * (self.asked - killed))} left" if killed else ""
        self.say(f"kill {killed} of {self.asked}{where}{left}")
