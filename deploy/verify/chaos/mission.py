"""A mission under faults: it is flown like any other, faults are injected, and it must recover from each."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

from deploy.run import plan
from deploy.run.mission import Mission
from deploy.run.progress import StatusPoller
from deploy.run.supervisor import MissionFailed, Supervisor
from deploy.verify.chaos.checker import Snapshot
from deploy.verify.chaos.faults import CUT, KILL, POWER, STOP, Fault, role
from deploy.verify.chaos.power import cut_tails
from deploy.verify.chaos.proxy import CuttableProxy
from deploy.verify.chaos.schedule import FaultSchedule, Growth
from tmc.record.run_folder import RunFolder

POLL_S = 0.02
"""Interval (s) at which the processes and their progress are checked."""
RECOVERY_TIMEOUT_S = 60.0
"""Longest time (s) that a process may take to recover."""
DRAIN_S = 0.05
"""Time (s) in which UAVs receive what a killed TMC had sent."""
MIN_UPDATES = 5
"""Updates that prove that a learner works: four may be sent unused, to it and to its predecessor."""


class MissionEnded(Exception):  # noqa: N818  not an error: the flight is over
    """The TMC has ended the mission."""


class PowerCut(Exception):  # noqa: N818  not an error: it is an injected fault
    """A power cut: all processes must be killed."""


@dataclass
class Recovery:
    """A killed process that must recover. `killed_at`: s of the monotonic clock.

    Once a new process runs: `growth` since then, and the size of its ack file at that time.
    """

    killed_pid: int
    killed_at: float
    growth: Growth | None = None
    ack_bytes: int = 0


class ChaosMission(Mission):
    """A mission under a schedule of faults. `lasts`: it flies to its own end; otherwise it ends with the schedule."""

    schedule: FaultSchedule
    lasts: bool

    def _fly(self) -> None:
        self.plan = plan.make(self.config, self.out, policy=self.policy)
        self.proxy = CuttableProxy(self.plan)
        self.supervisor = Supervisor(
            self.proxy.plan, self.out, self.config.training.threads, self.schedule.on_supervisor_note
        )
        self.observer = StatusPoller(self.plan.endpoint)
        try:
            self.supervisor.start()
            self._inject_faults()
        except MissionEnded:
            self.schedule.power_restored(measured=False)
            self.supervisor.wait(15.0)
        except PowerCut:
            self._lose_power()
        finally:
            self._end()

    def _compact(self) -> None:
        if self.schedule.power_lost is None:  # otherwise the mission is resumed
            super()._compact()

    def _end(self) -> None:
        self.observer.close()
        self.supervisor.stop()
        self.supervisor.close()
        self.proxy.close()
        self._ended = {"exit_codes": self.supervisor.exit_codes(), "restarts": self.supervisor.restarts()}

    def _inject_faults(self) -> None:
        """Inject every remaining fault, then fly without faults. Raises MissionEnded, PowerCut, MissionFailed."""
        self._poll_until(self._under_way, "the mission", "started")
        self.schedule.power_restored(measured=True)
        while (fault := self.schedule.next) is not None:
            self._poll_for(fault.pause)
            self.schedule.start_next()
            _INJECT[fault.kind](self, fault)
        self.schedule.finish(self._poll_until(self._under_way, "the mission", "resumed"))
        while self.lasts:
            self._poll()

    # Observing.

    def _poll(self) -> None:
        """Check the processes and the progress once, and sleep. Raises MissionEnded, MissionFailed."""
        if self.supervisor.watch():
            raise MissionEnded
        self.schedule.growth.update(self.observer.ask())
        self.schedule.show()
        time.sleep(POLL_S)

    def _poll_for(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._poll()

    def _poll_until(self, condition: Callable[[], bool], subject: str, action: str) -> float:
        """Poll until the condition holds; return the time (s) that it took.

        Raises MissionFailed, "SUBJECT has not ACTION", after RECOVERY_TIMEOUT_S.
        """
        start = time.monotonic()
        self.schedule.growth = Growth()
        while not condition():
            if time.monotonic() - start > RECOVERY_TIMEOUT_S:
                limit, logs = f"{RECOVERY_TIMEOUT_S:g} s", self.out / "logs"
                raise MissionFailed(f"{subject} has not {action} within {limit}; its logs are in {logs}")
            self._poll()
        return time.monotonic() - start

    def _under_way(self) -> bool:
        """Return whether ticks are flown and the learner, if there is one, makes updates."""
        growth = self.schedule.growth
        return growth.ticks > 0 and (growth.updates > 0 or not self._learns())

    def _learns(self) -> bool:
        return any(child.name == "learner" for child in self.plan.children)

    # Faults.

    def _cut(self, fault: Fault) -> None:
        self.proxy.cut(fault.seconds, fault.draw)
        self._poll_for(fault.seconds)

    def _stop(self, fault: Fault) -> None:
        pid = self._pid(fault.targets[0])
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
            try:
                self._poll_for(fault.seconds)
            finally:
                os.kill(pid, signal.SIGCONT)

    def _kill(self, fault: Fault) -> None:
        """Kill the targets one after the other, and wait until all have recovered."""
        recoveries: dict[str, Recovery] = {}
        left = [*fault.targets]
        try:
            while left:
                if len(left) < len(fault.targets):
                    self._poll_for(fault.seconds)
                name = left[0]
                pid = self._pid(name)
                if name in recoveries:
                    self.schedule.note_recovery(role(name), None)  # it is killed again
                recoveries[name] = Recovery(pid, time.monotonic())
                self._kill_one(left.pop(0), pid)
            self._poll_until(lambda: self._all_recovered(recoveries), " and ".join(recoveries), "recovered")
        except MissionEnded:  # which needs all of them
            for name in recoveries:
                self.schedule.note_recovery(role(name), None)
            self.schedule.postpone(replace(fault, targets=tuple(left)))
            raise
        finally:
            self.schedule.check_snapshots()

    def _kill_one(self, name: str, pid: int) -> None:
        self.schedule.kills[role(name)] += 1
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        if name == "tmc":
            time.sleep(DRAIN_S)  # the supervisor restarts it at the next poll at the earliest
            self.schedule.snapshots.append(Snapshot.capture(self.out))

    def _pid(self, name: str) -> int:
        """Wait for a process of this name; return its id."""
        self._poll_until(lambda: name in self.supervisor.pids(), name, "started")
        return self.supervisor.pids()[name]

    def _all_recovered(self, recoveries: dict[str, Recovery]) -> bool:
        """Remove the processes that work again from `recoveries`; return whether none is left."""
        pids = self.supervisor.pids()
        for name, recovery in [*recoveries.items()]:
            acks = RunFolder(self.out).acks_of(name)
            if recovery.growth is None:
                if pids.get(name, recovery.killed_pid) != recovery.killed_pid:
                    recovery.growth, recovery.ack_bytes = Growth(), size_of(acks)
                continue
            recovery.growth.update(self.schedule.growth.last)
            if _IS_WORKING[role(name)](recovery.growth, size_of(acks) - recovery.ack_bytes):
                self.schedule.note_recovery(role(name), time.monotonic() - recovery.killed_at)
                del recoveries[name]
        return not recoveries

    def _power(self, _fault: Fault) -> None:
        raise PowerCut

    def _lose_power(self) -> None:
        """Kill all processes at once, and cut from their files what was not synced."""
        fault = self.schedule.last
        self.schedule.kills[POWER] += 1
        self.schedule.power_lost = time.monotonic()
        for pid in self.supervisor.pids().values():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.supervisor.wait(RECOVERY_TIMEOUT_S)
        self.schedule.bytes_cut += cut_tails(self.out, Random(fault.draw))
        self.schedule.snapshots.append(Snapshot.capture(self.out))
        self.schedule.check_snapshots()


_INJECT: dict[str, Callable[[ChaosMission, Fault], Any]] = {
    KILL: ChaosMission._kill, STOP: ChaosMission._stop, CUT: ChaosMission._cut, POWER: ChaosMission._power,
}  # fmt: skip


_IS_WORKING: dict[str, Callable[[Growth, int], bool]] = {
    "tmc": lambda growth, _acks: growth.ticks + growth.updates > 0,
    "learner": lambda growth, _acks: growth.updates >= MIN_UPDATES,
    "uav": lambda _growth, acks: acks > 0,
}
"""By role, whether a restarted process works: by the growth of ticks and updates, and of its ack file (bytes)."""


def size_of(path: Path) -> int:
    """Return the size of a file in bytes, 0 if it does not exist."""
    return path.stat().st_size if path.exists() else 0
