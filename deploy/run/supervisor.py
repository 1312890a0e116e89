"""Starts the processes of a plan, starts crashed ones again with back-off, and ends them all in order."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from deploy.run import plan as plans
from deploy.run.forked import ForkServer, Handle, forkserver_command
from deploy.run.suspension import Suspension
from tmc.kernel.text import printable
from tmc.wire import process

BACKOFF_S = (0.1, 5.0)
"""Seconds before a crashed process is started again: the first time, and at most; doubles in between."""
STEADY_S = 10.0
"""Seconds up after which a crash counts as the first again."""
MAX_CRASHES = 6
"""Crashes in a row after which the run is given up."""
_ORDERLY = {128 + s for s in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
OUTSIDE = {-signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT, -signal.SIGHUP, *_ORDERLY}
"""Ends that somebody else brought about: the process is started again, and it does not count as a crash."""
START_TIME_S = 0.4
"""Seconds in which a TMC that was started has not sent anybody home yet: it takes longer to import what it needs."""
LEAVE_TIMEOUT_S = 5.0
"""Seconds after which a TMC that still runs needs whoever left: it stays for 3 s at most once everybody has."""
FULL_DISK_BYTES = 2**20
"""Free bytes of a disk that counts as full when a process fails."""
GRACE_S = 15.0
"""Seconds that processes get to leave before they are killed."""
FINAL = {process.USAGE, process.FENCED}
"""Exit codes after which a process is not started again."""


class MissionFailed(process.FailedError):
    """A process failed and is not started again: which one, how, and where its output is."""


@dataclass
class _Running:
    child: plans.Child
    handle: Handle | None = None
    started: float = 0.0
    crashes: int = 0
    restarts: int = 0
    left: float = 0.0
    """When it was first seen to have ended in order; 0.0 while it has not."""
    again_at: float = 0.0


class Supervisor:
    """Runs a plan; `say` takes one-line notes for the user."""

    def __init__(self, plan: plans.Plan, out: Path, threads: int, say: Callable[[str], None]) -> None:
        self.plan, self.out, self.threads, self.say = plan, out, threads, say
        self.running = [_Running(child) for child in plan.children]
        self._suspension: Suspension | None = None
        self._adopts = process.adopts_orphans()
        self._forkservers = {name: self._forkserver(name) for name in {c.fork_of for c in plan.children} - {""}}

    def start(self) -> None:
        """Start all processes."""
        (self.out / "logs").mkdir(exist_ok=True)
        self._suspension = Suspension(lambda: self.pids().values())
        for running in self.running:
            self._start(running)

    def _forkserver(self, package: str) -> ForkServer:
        """The forkserver of a package; it starts with the first process that it forks."""
        room = max(len(" ".join(c.command)) for c in self.plan.children if c.fork_of == package) + 64
        command = forkserver_command(package, self.out, self.plan.preload.get(package, ()), room)
        return ForkServer(command, self._environment(package), self.log_of(f"forkserver-{package}"))

    def _environment(self, name: str) -> dict[str, str]:
        return plans.environment(name, self.threads if name == "learner" else 1)

    def log_of(self, name: str) -> Path:
        """Where a process's own output goes."""
        return self.out / "logs" / f"{name}.txt"

    def _start(self, running: _Running) -> None:
        child, log = running.child, self.log_of(running.child.name)
        running.started = time.monotonic()
        try:
            if child.fork_of:
                running.handle = self._forkservers[child.fork_of].start(child.name, child.command, log)
            else:
                running.handle = self._spawn(child, log)
        except OSError as error:
            raise MissionFailed(f"{child.name} cannot be started: {error.strerror or error}") from None

    def _spawn(self, child: plans.Child, log: Path) -> Handle:
        with log.open("ab") as output:
            return subprocess.Popen(
                child.command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=self._environment(child.name),
                start_new_session=True,  # Ctrl-C in the terminal is for the supervisor, who ends all in order
            )

    def watch(self) -> bool:
        """Look after the processes once; True when the mission is over. Raises MissionFailed."""
        if self._suspension is not None:
            self._suspension.take()
        self._reap_orphans()
        for running in self.running:
            if running.handle is None:
                if time.monotonic() >= running.again_at:
                    self._start(running)
                continue
            code = running.handle.poll()
            if code == 0 and running.child.leads:
                return True
            if code:
                self._ended(running, code)
            elif code == 0:
                running.left = running.left or time.monotonic()
                if self._left_a_former_life(running):
                    self._again(running, "left before the TMC was back", BACKOFF_S[0])
        return False

    def _reap_orphans(self) -> None:
        """Collect the processes of a forkserver that was killed, where they become zombies of this process.

        No others: this process may be a user's program with children of its own.
        """
        for server in self._forkservers.values() if self._adopts else ():
            for pid in [*server.orphans]:
                with suppress(ChildProcessError):
                    if os.waitpid(pid, os.WNOHANG) == (0, 0):
                        continue  # it has not ended yet
                server.orphans.discard(pid)

    def _left_a_former_life(self, running: _Running) -> bool:
        """Whether it was sent home by an incarnation of the TMC that is over: the next one may need it all the same."""
        lead = next((r for r in self.running if r.child.leads and r.handle is not None), None)
        if lead is None or running.started > lead.started:
            return False
        return running.left < lead.started + START_TIME_S or time.monotonic() > running.left + LEAVE_TIMEOUT_S

    def _ended(self, running: _Running, code: int) -> None:
        """A process ended that should not have: start it again, or give up."""
        child, up = running.child, time.monotonic() - running.started
        crashed = code not in OUTSIDE
        running.crashes = crashed + (0 if up > STEADY_S else running.crashes)
        how = process.how_it_ended(code)
        log = self.log_of(child.name)
        reason = self._reason(child, code)
        if crashed and shutil.disk_usage(self.out).free < FULL_DISK_BYTES:  # then its own sentence found no room either
            mend = f"free some space, and go on with `overfly run --resume {self.out}`"
            raise MissionFailed(f"{child.name} {how}: the disk that holds {self.out} is full; {mend}")
        if not child.restart or code in FINAL or running.crashes >= MAX_CRASHES:
            raise MissionFailed(f"{child.name} {how}{reason}; its output is in {log}")
        delay = min(BACKOFF_S[0] * 2 ** (running.crashes - 1), BACKOFF_S[1]) if crashed else BACKOFF_S[0]
        self._again(running, f"{how}{reason}", delay)

    def _again(self, running: _Running, how: str, delay: float) -> None:
        """Start a process again, a while later."""
        running.handle, running.left, running.again_at = None, 0.0, time.monotonic() + delay
        running.restarts += 1
        self.say(f"{running.child.name} {how}; it is started again (log: {self.log_of(running.child.name)})")

    def _reason(self, child: plans.Child, code: int) -> str:
        """The error that a process left as its last line, or that of the forkserver which could not start it.

        A library that aborts the process, as ZeroMQ does without a free descriptor, says so in words of its own.
        """
        for name in (child.name, f"forkserver-{child.fork_of}"):
            log = self.log_of(name)
            text = process.last_error(log.read_text("utf-8", errors="replace")) if log.exists() else ""
            if text:
                return f": {text[:300]}"
        log = self.log_of(child.name)
        if code == -signal.SIGABRT and log.exists() and (said := log.read_text("utf-8", errors="replace").split("\n")):
            return (
                ": " + printable(next((line for line in reversed(said) if line.strip()), "no reason was given"))[:300]
            )
        return ""

    def stop(self) -> None:
        """Ask everybody to leave; the TMC last, so that nothing is shipped in vain. Kill who does not."""
        for leads in (False, True):
            group = [r for r in self.running if r.child.leads is leads]
            for running in group:
                if running.handle is not None:
                    running.handle.send_signal(signal.SIGTERM)
            self.wait(GRACE_S, group)

    def wait(self, patience: float, group: list[_Running] | None = None) -> None:
        """Wait for everybody (or a group) to leave; kill who has not after `patience` seconds."""
        until = time.monotonic() + patience
        for running in self.running if group is None else group:
            if running.handle is None:
                continue
            try:
                running.handle.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                self.say(f"{running.child.name} did not leave in {patience:g} s and is killed")
                running.handle.send_signal(signal.SIGKILL)
                running.handle.wait()

    def pids(self) -> dict[str, int]:
        """The processes that run now, and the forkservers, each as `forkserver-` and its package."""
        handles = {r.child.name: r.handle for r in self.running if r.handle is not None and r.handle.poll() is None}
        found = {name: handle.pid for name, handle in handles.items()}
        found |= {f"forkserver-{package}": server.pid for package, server in self._forkservers.items()}
        return {name: pid for name, pid in found.items() if pid is not None}

    def exit_codes(self) -> dict[str, int | None]:
        """The last exit code of each process, None where it never ended."""
        return {r.child.name: None if r.handle is None else r.handle.returncode for r in self.running}

    def restarts(self) -> dict[str, int]:
        """How often each process was started again."""
        return {r.child.name: r.restarts for r in self.running if r.restarts}

    def close(self) -> None:
        """End the forkservers, and remove what the processes shared."""
        if self._suspension is not None:
            self._suspension.close()
        for server in self._forkservers.values():
            server.close()
        self._reap_orphans()
        with suppress(OSError):
            shutil.rmtree(self.plan.scratch)
        if self.plan.held is not None:
            self.plan.held.close()
