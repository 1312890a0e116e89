"""A mission that is disturbed: it is flown as any other, and struck now and then; then it must find its way back."""

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

LOOK_INTERVAL_S = 0.02
"""Seconds between two looks at the processes and their progress."""
PATIENCE_S = 60.0
"""Seconds that a process may take to be back and working."""
DRAIN_S = 0.05
"""Seconds in which UAVs take what a TMC that was killed had sent before."""
UPDATES = 5
"""Minibatches after which a learner works for sure: four may go out to it, and to the one before it, unused."""


class Over(Exception):  # noqa: N818  no error: the mission is at its end
    """The TMC has ended the mission."""


class PowerCut(Exception):  # noqa: N818  no error: it was asked for
    """All processes are dead."""


@dataclass
class Awaited:
    """A process that was killed, and when. Once a new one is there: what grew since, and the size of its acks then."""

    killed: int
    at: float
    growth: Growth | None = None
    acks: int = 0


class Disturbed(Mission):
    """A mission under a schedule. `lasts`: it flies to its own end; else it is ended in order once the schedule is
    over.
    """

    schedule: FaultSchedule
    lasts: bool

    def _fly(self) -> None:
        self.plan = plan.make(self.config, self.out, policy=self.policy)
        self.proxy = CuttableProxy(self.plan)
        self.supervisor = Supervisor(self.proxy.plan, self.out, self.config.training.threads, self.schedule.note)
        self.observer = StatusPoller(self.plan.endpoint)
        try:
            self.supervisor.start()
            self._disturb()
        except Over:
            self.schedule.power_restored(measured=False)
            self.supervisor.wait(15.0)
        except PowerCut:
            self._lose_power()
        finally:
            self._end()

    def _compact(self) -> None:
        if self.schedule.power_lost is None:  # else it goes on
            super()._compact()

    def _end(self) -> None:
        self.observer.close()
        self.supervisor.stop()
        self.supervisor.close()
        self.proxy.close()
        self._ended = {"exit_codes": self.supervisor.exit_codes(), "restarts": self.supervisor.restarts()}

    def _disturb(self) -> None:
        """Every fault that is left, and then calm."""
        self._until(self._under_way, "the mission", "begun")
        self.schedule.power_restored(measured=True)
        while (fault := self.schedule.next) is not None:
            self._look_on(fault.pause)
            self.schedule.started()
            _INJECT[fault.kind](self, fault)
        self.schedule.finish(self._until(self._under_way, "the mission", "gone on"))
        while self.lasts:
            self._look()

    # Looking on.

    def _look(self) -> None:
        """One look at everything, and a rest. Raises Over when the mission is."""
        if self.supervisor.watch():
            raise Over
        self.schedule.growth.take(self.observer.ask())
        self.schedule.show()
        time.sleep(LOOK_INTERVAL_S)

    def _look_on(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._look()

    def _until(self, so: Callable[[], bool], who: str, what: str) -> float:
        """Look on until something is so; returns the seconds that took. Raises MissionFailed when it takes too long."""
        start = time.monotonic()
        self.schedule.growth = Growth()
        while not so():
            if time.monotonic() - start > PATIENCE_S:
                raise MissionFailed(f"{who} has not {what} for {PATIENCE_S:g} s; its logs are in {self.out / 'logs'}")
            self._look()
        return time.monotonic() - start

    def _under_way(self) -> bool:
        """Ticks are flown, and where there is a learner it learns."""
        growth = self.schedule.growth
        return growth.ticks > 0 and (growth.updates > 0 or not self._learns())

    def _learns(self) -> bool:
        return any(child.name == "learner" for child in self.plan.children)

    # Blows.

    def _cut(self, fault: Fault) -> None:
        self.proxy.cut(fault.seconds, fault.draw)
        self._look_on(fault.seconds)

    def _stop(self, fault: Fault) -> None:
        pid = self._pid(fault.targets[0])
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
            try:
                self._look_on(fault.seconds)
            finally:
                os.kill(pid, signal.SIGCONT)

    def _kill(self, fault: Fault) -> None:
        """Kill one after the other, and wait for all."""
        awaited: dict[str, Awaited] = {}
        left = [*fault.targets]
        try:
            while left:
                if len(left) < len(fault.targets):
                    self._look_on(fault.seconds)
                name = left[0]
                pid = self._pid(name)
                if name in awaited:
                    self.schedule.back(role(name), None)  # to be killed again
                awaited[name] = Awaited(pid, time.monotonic())
                self._kill_one(left.pop(0), pid)
            self._until(lambda: self._all_back(awaited), " and ".join(awaited), "gone on with its work")
        except Over:  # it could not be without all of them
            for name in awaited:
                self.schedule.back(role(name), None)
            self.schedule.later(replace(fault, targets=tuple(left)))
            raise
        finally:
            self.schedule.check_snapshots()

    def _kill_one(self, name: str, pid: int) -> None:
        self.schedule.kills[role(name)] += 1
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        if name == "tmc":
            time.sleep(DRAIN_S)  # nobody starts it again before the next look
            self.schedule.snapshots.append(Snapshot.take(self.out))

    def _pid(self, name: str) -> int:
        """The process of this name, as soon as there is one."""
        self._until(lambda: name in self.supervisor.pids(), name, "started")
        return self.supervisor.pids()[name]

    def _all_back(self, awaited: dict[str, Awaited]) -> bool:
        """Take those who are back out of `awaited`; true when that was the last."""
        pids = self.supervisor.pids()
        for name, who in [*awaited.items()]:
            acks = RunFolder(self.out).acks_of(name)
            if who.growth is None:
                if pids.get(name, who.killed) != who.killed:
                    who.growth, who.acks = Growth(), size_of(acks)
                continue
            who.growth.take(self.schedule.growth.last)
            if _WORKS[role(name)](who.growth, size_of(acks) - who.acks):
                self.schedule.back(role(name), time.monotonic() - who.at)
                del awaited[name]
        return not awaited

    def _power(self, _fault: Fault) -> None:
        raise PowerCut

    def _lose_power(self) -> None:
        """Kill everybody at once, and cut what was not on the disk."""
        fault = self.schedule.last
        self.schedule.kills[POWER] += 1
        self.schedule.power_lost = time.monotonic()
        for pid in self.supervisor.pids().values():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.supervisor.wait(PATIENCE_S)
        self.schedule.cut_off += cut_tails(self.out, Random(fault.draw))
        self.schedule.snapshots.append(Snapshot.take(self.out))
        self.schedule.check_snapshots()


_INJECT: dict[str, Callable[[Disturbed, Fault], Any]] = {
    KILL: Disturbed._kill, STOP: Disturbed._stop, CUT: Disturbed._cut, POWER: Disturbed._power,
}  # fmt: skip


_WORKS: dict[str, Callable[[Growth, int], bool]] = {
    "tmc": lambda growth, _acks: growth.ticks + growth.updates > 0,
    "learner": lambda growth, _acks: growth.updates >= UPDATES,
    "uav": lambda _growth, acks: acks > 0,
}
"""What shows that a process that was started anew works: growth of ticks, updates and the UAV's own acks."""


def size_of(path: Path) -> int:
    """Bytes; 0 while there is no such file."""
    return path.stat().st_size if path.exists() else 0
