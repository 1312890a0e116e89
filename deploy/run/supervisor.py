"""Starts the processes of a plan, restarts crashed ones with back-off, and ends them all in order."""

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
from tmc.record.run_folder import RunFolder
from tmc.wire import process

BACKOFF_S = (0.1, 5.0)
"""Delay (s) before a crashed process is restarted: first and longest; it doubles in between."""
STEADY_S = 10.0
"""Uptime (s) after which a crash counts as the first again."""
MAX_CRASHES = 6
"""Crashes in a row after which the run fails."""
_ORDERLY = {128 + s for s in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
OUTSIDE = {-signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT, -signal.SIGHUP, *_ORDERLY}
"""Exit codes of a process that was ended from outside: it is restarted, and this does not count as a crash."""
START_TIME_S = 0.4
"""Time (s) in which a started TMC cannot have ended any process yet, because its imports take longer."""
LEAVE_TIMEOUT_S = 5.0
"""Time (s) after which a TMC that still runs needs the processes that left: it stays at most 3 s after the last."""
FULL_DISK_BYTES = 2**20
"""Free space below which a disk counts as full when a process fails."""
GRACE_S = 15.0
"""Time (s) that processes get to end before they are killed."""
FINAL = {process.USAGE, process.FENCED}
"""Exit codes after which a process is not restarted."""


class MissionFailed(process.FailedError):
    """A process failed and is not restarted: which one, how, and where its output is."""


@dataclass
class _Process:
    """A process of the plan. Times are s of the monotonic clock."""

    child: plans.Child
    handle: Handle | None = None
    started: float = 0.0
    crashes: int = 0
    restarts: int = 0
    left: float = 0.0
    """When its end in order was first seen; 0.0 before."""
    restart_at: float = 0.0


class Supervisor:
    """Runs a plan. `threads`: of the learner. `note` gets one-line notes for the user."""

    def __init__(self, plan: plans.Plan, out: Path, threads: int, note: Callable[[str], None]) -> None:
        self.plan, self.out, self.threads, self.note = plan, out, threads, note
        self.running = [_Process(child) for child in plan.children]
        self._suspension: Suspension | None = None
        self._adopts = process.adopts_orphans()
        self._forkservers = {name: self._forkserver(name) for name in {c.fork_of for c in plan.children} - {""}}

    def start(self) -> None:
        """Start all processes. Raises MissionFailed."""
        RunFolder(self.out).outputs.mkdir(exist_ok=True)
        self._suspension = Suspension(lambda: self.pids().values())
        for running in self.running:
            self._start(running)

    def _forkserver(self, package: str) -> ForkServer:
        """Return the forkserver of a package; it starts with the first process that it forks."""
        command = forkserver_command(package, self.out, self.plan.preload.get(package, ()))
        return ForkServer(command, self._environment(package), self.log_of(f"forkserver-{package}"))

    def _environment(self, name: str) -> dict[str, str]:
        return plans.environment(name, self.threads if name == "learner" else 1)

    def log_of(self, name: str) -> Path:
        """Return the file for a process's own output."""
        return RunFolder(self.out).output(name)

    def _start(self, running: _Process) -> None:
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
                start_new_session=True,  # Ctrl-C in the terminal is for the supervisor, which ends all in order
            )

    def watch(self) -> bool:
        """Check the processes once, restart where due; return whether the mission is over. Raises MissionFailed."""
        if self._suspension is not None:
            self._suspension.suspend_if_asked()
        self._reap_orphans()
        for running in self.running:
            if running.handle is None:
                if time.monotonic() >= running.restart_at:
                    self._start(running)
                continue
            code = running.handle.poll()
            if code == 0 and running.child.leads:
                return True
            if code:
                self._ended(running, code)
            elif code == 0:
                running.left = running.left or time.monotonic()
                if self._left_previous_incarnation(running):
                    self._schedule_restart(running, "left before the TMC was back", BACKOFF_S[0])
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

    def _left_previous_incarnation(self, running: _Process) -> bool:
        """Return whether a previous incarnation of the TMC ended this process, so that the current one may need it."""
        lead = next((r for r in self.running if r.child.leads and r.handle is not None), None)
        if lead is None or running.started > lead.started:
            return False
        return running.left < lead.started + START_TIME_S or time.monotonic() > running.left + LEAVE_TIMEOUT_S

    def _ended(self, running: _Process, code: int) -> None:
        """Restart a process that ended too early, or fail. Raises MissionFailed."""
        child, up = running.child, time.monotonic() - running.started
        crashed = code not in OUTSIDE
        running.crashes = crashed + (0 if up > STEADY_S else running.crashes)
        how = process.how_it_ended(code)
        log = self.log_of(child.name)
        reason = self._reason(child, code)
        if crashed and shutil.disk_usage(self.out).free < FULL_DISK_BYTES:  # then its log may lack the reason
            fix = f"free some space, and resume with `overfly run --resume {self.out}`"
            raise MissionFailed(f"{child.name} {how}: the disk that holds {self.out} is full; {fix}")
        if not child.restart or code in FINAL or running.crashes >= MAX_CRASHES:
            raise MissionFailed(f"{child.name} {how}{reason}; its output is in {log}")
        delay = min(BACKOFF_S[0] * 2 ** (running.crashes - 1), BACKOFF_S[1]) if crashed else BACKOFF_S[0]
        self._schedule_restart(running, f"{how}{reason}", delay)

    def _schedule_restart(self, running: _Process, how: str, delay: float) -> None:
        """Restart a process after `delay` seconds; note how it ended."""
        running.handle, running.left, running.restart_at = None, 0.0, time.monotonic() + delay
        running.restarts += 1
        self.note(f"{running.child.name} {how}; it is started again (log: {self.log_of(running.child.name)})")

    def _reason(self, child: plans.Child, code: int) -> str:
        """Return the error in a process's last line of output, or in that of the forkserver that failed to start it.

        After an abort, as by ZeroMQ without a free descriptor, the last line is the library's own message.
        """
        for name in (child.name, f"forkserver-{child.fork_of}"):
            log = self.log_of(name)
            text = process.last_error(log.read_text("utf-8", errors="replace")) if log.exists() else ""
            if text:
                return f": {text[:300]}"
        log = self.log_of(child.name)
        if (
            code == -signal.SIGABRT
            and log.exists()
            and (output := log.read_text("utf-8", errors="replace").split("\n"))
        ):
            return (
                ": " + printable(next((line for line in reversed(output) if line.strip()), "no reason was given"))[:300]
            )
        return ""

    def stop(self) -> None:
        """End all processes, the TMC last so that no record is shipped in vain; kill those that do not end."""
        for leads in (False, True):
            group = [r for r in self.running if r.child.leads is leads]
            for running in group:
                if running.handle is not None:
                    running.handle.send_signal(signal.SIGTERM)
            self.wait(GRACE_S, group)

    def wait(self, timeout: float, group: list[_Process] | None = None) -> None:
        """Wait for all processes (or a group) to end; kill those that still run after `timeout` seconds."""
        until = time.monotonic() + timeout
        for running in self.running if group is None else group:
            if running.handle is None:
                continue
            try:
                running.handle.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                self.note(f"{running.child.name} did not end within {timeout:g} s and is killed")
                running.handle.send_signal(signal.SIGKILL)
                running.handle.wait()

    def pids(self) -> dict[str, int]:
        """Return the ids of the running processes by name, and of the forkservers as `forkserver-<package>`."""
        handles = {r.child.name: r.handle for r in self.running if r.handle is not None and r.handle.poll() is None}
        found = {name: handle.pid for name, handle in handles.items()}
        found |= {f"forkserver-{package}": server.pid for package, server in self._forkservers.items()}
        return {name: pid for name, pid in found.items() if pid is not None}

    def exit_codes(self) -> dict[str, int | None]:
        """Return the last exit code of each process, None if it never ended."""
        return {r.child.name: None if r.handle is None else r.handle.returncode for r in self.running}

    def restarts(self) -> dict[str, int]:
        """Return how often each process was restarted."""
        return {r.child.name: r.restarts for r in self.running if r.restarts}

    def close(self) -> None:
        """End the forkservers, and remove the scratch folder."""
        if self._suspension is not None:
            self._suspension.close()
        for server in self._forkservers.values():
            server.close()
        self._reap_orphans()
        with suppress(OSError):
            shutil.rmtree(self.plan.scratch)
        if self.plan.held is not None:
            self.plan.held.close()
