"""The schedule of faults, and the results of those injected so far. It may last for several missions."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from deploy.run.progress import clock
from deploy.verify.chaos.checker import RecordId, Snapshot
from deploy.verify.chaos.faults import POWER, Fault
from tmc.wire import messages as m


@dataclass
class Growth:
    """The growth of ticks and updates since the first status."""

    ticks: int = 0
    updates: int = 0
    last: m.Status | None = None

    def update(self, status: m.Status | None) -> None:
        """Add a status. Fewer updates, of a learner that restarts from its checkpoint, do not reduce the growth."""
        if status is not None and self.last is not None:
            self.ticks += max(0, status.ticks - self.last.ticks)
            self.updates += max(0, status.updates - self.last.updates)
        self.last = status or self.last


class FaultSchedule:
    """Holds the faults to inject, and counts what they did.

    `show_progress` shows a line of progress. `history`: the file in which every event is logged with its time.
    `until_loss`: the schedule is over as soon as a loss is found.
    """

    def __init__(
        self, faults: Iterable[Fault], show_progress: Callable[[str], None], history: Path, *, until_loss: bool = False
    ) -> None:
        self._left, self._history, self._until_loss = deque(faults), history, until_loss
        self.show_progress = show_progress
        self.planned_kills = sum(fault.kills for fault in self._left)
        self.done: list[Fault] = []
        self.kills: Counter[str] = Counter()
        self.recovered: Counter[str] = Counter()
        self.recoveries: defaultdict[str, list[float]] = defaultdict(list)
        self.crashes: list[str] = []
        self.failures: list[str] = []
        self.snapshots: list[Snapshot] = []
        self.lost: set[RecordId] = set()
        """Records of this mission that were acknowledged and did not survive a kill."""
        self.bytes_cut = 0
        self.power_lost: float | None = None
        """When the power was lost (s of the monotonic clock), until the mission is resumed."""
        self.growth = Growth()
        self.resumed = False
        self._start = time.monotonic()

    @property
    def next(self) -> Fault | None:
        """The next fault, or None when the schedule is over."""
        return self._left[0] if self._left else None

    @property
    def last(self) -> Fault:
        """The last fault injected."""
        return self.done[-1]

    def start_next(self) -> None:
        """Note that the next fault is injected now."""
        self.done.append(fault := self._left.popleft())
        self.log(f"{fault.kind} {' '.join(fault.targets)} ({fault.seconds:.2f} s)")

    def postpone(self, fault: Fault) -> None:
        """Keep the rest of a fault for the next mission, because this mission ended first."""
        if fault.targets:
            self._left.appendleft(fault)

    def count(self, kind: str) -> int:
        """Return the number of faults of a kind so far."""
        return sum(fault.kind == kind for fault in self.done)

    def note_recovery(self, role: str, seconds: float | None) -> None:
        """Note that a killed process works again, `seconds` after the kill; None if that could not be measured."""
        self.recovered[role] += 1
        if seconds is not None:
            self.recoveries[role].append(seconds)
            self.log(f"{role} recovered after {seconds:.2f} s")

    def power_restored(self, *, measured: bool) -> None:
        """Note, if the power was lost, that the mission is resumed or has ended."""
        if self.power_lost is not None:
            self.note_recovery(POWER, time.monotonic() - self.power_lost if measured else None)
            self.power_lost = None

    def check_snapshots(self) -> None:
        """Find the losses in the journals that kills have left."""
        while self.snapshots:
            lost = self.snapshots.pop().lost()
            self.lost |= lost
            if lost:
                self._left = deque() if self._until_loss else self._left
                self.log(f"{len(lost)} acknowledged records did not survive: {sorted(lost)[:10]}")

    def finish(self, seconds: float) -> None:
        """Note that the mission flies on after the last fault."""
        self.resumed = True
        self.log(f"the mission flies on after the last fault, for {seconds:.2f} s")

    def on_supervisor_note(self, text: str) -> None:
        """Log a note of the supervisor; keep it if a process failed without a fault."""
        if "with exit code" in text or "did not end" in text:
            self.crashes.append(text)
        self.log(text)

    def log(self, text: str) -> None:
        """Write a line to the history."""
        with self._history.open("a", encoding="utf-8") as file:
            file.write(f"{time.monotonic() - self._start:8.2f} {text}\n")

    def show(self) -> None:
        """Show the progress."""
        killed, spent = sum(self.kills.values()), time.monotonic() - self._start
        status = self.growth.last
        where = f" · episode {status.episode} tick {status.tick} · {status.updates:,} updates" if status else ""
        left = f" · {clock(spent / killed * (self.planned_kills - killed))} left" if killed else ""
        self.show_progress(f"kill {killed} of {self.planned_kills}{where}{left}")
