"""A mission from its config to its run folder: processes or lock step, then the summary and the pictures."""

from __future__ import annotations

import json
import os
import platform
import shlex
import signal
import sys
import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from actors.planners import PLANNERS, PREFIX
from deploy import extras, policy_spec
from deploy.run import lockstep, plan
from deploy.run.progress import Progress, StatusPoller
from deploy.run.supervisor import MissionFailed, Supervisor
from tmc.analysis.run_config import attachments, settings_of
from tmc.center.journal import journal_in
from tmc.kernel import files, forecast
from tmc.kernel.config import Config, ConfigError, flat
from tmc.kernel.files import plain
from tmc.kernel.policy import FlightError, check_view, view_shape
from tmc.kernel.roadmap import COPY
from tmc.kernel.text import suggestion
from tmc.kernel.uncertainty import lower_bound
from tmc.kernel.world import World, world_of_run
from tmc.record import disk
from tmc.record.errors import RecordError
from tmc.record.mcap.compact import compact_log
from tmc.record.reader import Log
from tmc.wire import capacity, process

POLL_S = 0.1
"""Seconds between two looks at the processes."""


def new_folder(out: Path | None, name: str) -> Path:
    """The run folder, which must not hold anything yet; by default `runs/<name>-<time>`."""
    if out is None:
        stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        out = Path("runs") / f"{name}-{stamp}"
        for n in range(2, 1000):
            if not out.exists():
                break
            out = Path("runs") / f"{name}-{stamp}-{n}"
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise ConfigError(f"{out} exists and is not empty: choose another --out, or remove it")
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot make the run folder {out}: {error.strerror}; choose another --out") from None
    return out


def bound_of(world: World) -> float:
    """What no team can beat: the lower bound of eq. (6) in scenario II from a visited map, otherwise 0 (unknown)."""
    config = world.config
    if config.scenario != 2 or config.world.initial_map != "visited":
        return 0.0
    return lower_bound(world.alpha, config.team.size, config.training.ticks)


def check(config: Config, policy: bytes | None = None, name: str = "the policy") -> World:
    """The world of a mission, once everything that can be wrong with its settings has been looked at.

    `name`: what messages call the policy.
    """
    if config.team.controller != "policy" and config.team.controller.removeprefix(PREFIX) not in PLANNERS:
        name = plain(config.team.controller, 60)
        fix = suggestion(name, ("policy", *policy_spec.KNOWN))
        raise ConfigError(f"team.controller = {name} is neither policy nor a planner: {fix}")
    world = World(config)
    _check(world, policy, name)
    return world


def _check(world: World, policy: bytes | None, name: str) -> None:
    """Whether a mission can be flown in a world."""
    config = world.config
    learning = policy is None and not policy_spec.is_planner(config)
    if policy is not None:
        policy_spec.require_policy(policy, world, name)
    elif learning:
        check_view(config, view_shape(config, world.grid))
    capacity.check(world, learning=learning)


def check_training(config: Config) -> None:
    """Raise ConfigError where nothing would be learned in a whole mission; and say what else will not be done."""
    if policy_spec.is_planner(config):
        return
    if idle := forecast.idle(config):
        raise ConfigError(idle)
    for sentence in forecast.remarks(config):
        process.tell(sentence)


def needs(config: Config, policy: bytes | None) -> tuple[str, ...]:
    """The extras that a mission on this machine needs: only one without a fixed policy or a planner has a learner."""
    return () if policy is not None or policy_spec.is_planner(config) else (extras.LEARNER,)


def flown_policy(out: Path) -> Path:
    """The fixed policy of a run that flies one."""
    return out / "policies" / "flown.onnx"


def require_settings(out: Path) -> Config:
    """The settings that a run in `out` was begun with; ConfigError where `config.json` has others, or it has none."""
    journal = journal_in(out)
    if journal is None:
        raise ConfigError(f"{out} holds no journal (tmc.mcap): --resume takes the folder of a run that was begun")
    settings = settings_of(out, journal)
    if settings.edited:
        keys = ", ".join(settings.edited)
        mend = "put it back, or remove the file and the log's settings are used; other settings need a run of their own"
        raise ConfigError(f"{out / 'config.json'} was edited since the run was begun, in {keys}: {mend}")
    return settings.config


def interrupted(out: Path) -> tuple[World, bytes | None]:
    """The world and the fixed policy of a run that was begun in `out`, to go on with it; raises ConfigError."""
    config = require_settings(out)
    journal = journal_in(out)
    assert journal is not None
    with disk.open_held(journal, "rb"):
        log = Log(journal)  # nobody writes it
    if log.damage and not log.still_open:
        text = f"{log.damage}: the run goes on from before that; the damaged file is kept as {journal.name}.damaged-*"
        process.tell(f"{text}, and `overfly log recover` says what else is in it")
    file = flown_policy(out)
    policy = files.read_bytes(file) if file.exists() else None
    world = world_of_run(config, out)
    _check(world, policy, str(file))
    if attachments(journal).get("map.csv", world.map.csv()) != world.map.csv():
        name = out / COPY if (out / COPY).exists() else config.world.map
        raise ConfigError(f"the map {name} has changed since the run was begun: put it back as it was")
    if log.metadata().get("run") == lockstep.RUN and policy is None and not policy_spec.is_planner(config):
        raise ConfigError(f"{out} was trained in lock step, which leaves no checkpoint to go on from: run it again")
    return world, policy


def keep_settings(out: Path, world: World, policy: bytes | None) -> Path | None:
    """Put down what a run flies by, before it begins: `config.json`, a user's map, and the fixed policy, whose path it
    returns.

    On the disk at once, since after a power cut there is no journal yet that has a copy.
    """
    disk.put(out / "config.json", (json.dumps(flat(world.config), indent=1) + "\n").encode(), sync=True)
    if world.map.source:
        disk.put(out / COPY, world.map.source.encode(), sync=True)
    if policy is None:
        return None
    file = flown_policy(out)
    file.parent.mkdir(parents=True, exist_ok=True)
    disk.put(file, policy, sync=True)
    return file


def finished(out: Path) -> bool:
    """True when the processes of the run in `out` came to its end, all of them in order."""
    codes = _told(out).get("exit_codes", {})
    return set(codes.values()) == {0} and (out / "tmc.mcap").exists()


def _told(out: Path) -> dict[str, Any]:
    """What `run.json` says; nothing where it is gone or broken."""
    try:
        told = json.loads(files.read_text(out / "run.json"))
    except (OSError, ValueError):
        return {}
    return told if isinstance(told, dict) else {}


class Mission:
    """One mission in its run folder; `world` comes from `check`."""

    def __init__(
        self,
        world: World,
        out: Path,
        command: str,
        policy: bytes | None = None,
        progress: Progress | None = None,
        flies: str = "",
    ) -> None:
        config = world.config
        self.world, self.config, self.out, self.command = world, config, out, command
        self.policy = keep_settings(out, world, policy)
        self.flies = flies or str(self.policy)
        self.progress = progress or Progress(config, self.world.law.cells.size, bound_of(self.world))
        self._begun, self._began_at, self._start = _told(out), datetime.now(UTC), time.monotonic()
        self._ended: dict[str, Any] = {}
        self._folder = out.stat()
        self._write_run(self._ended)

    def run(self, *, in_one_process: bool) -> int:
        """Fly it; returns the exit code. What it left is in the run folder either way."""
        code, said = process.DONE, ""
        try:
            if in_one_process:
                lockstep.run(self.world, self.out, self.policy, self.progress)
                self._ended = {"exit_codes": {lockstep.RUN: process.DONE}}
            else:
                self._fly()
            self._compact()
        except RecordError:
            if self._is_there():
                raise
            code, said = process.FAILED, self._gone()
        except (MissionFailed, FlightError) as failed:
            which = f" (policy 1 is {self.flies})" if self.policy and "policy 1" in str(failed) else ""
            code, said = process.FAILED, f"{failed}{which}"
        except KeyboardInterrupt as stopped:
            code = 128 + (stopped.args[0] if stopped.args else signal.SIGINT)
            said = f"stopped; what was flown is in {self.out}"
        finally:
            self._write_run(self._ended)  # first of all: what is said goes to a terminal that may be gone
            self.progress.clear()
        if said:
            self.progress.note(said)
        return code

    def _fly(self) -> None:
        mission = plan.make(self.config, self.out, policy=self.policy)
        supervisor = Supervisor(mission, self.out, self.config.training.threads, self.progress.note)
        observer = StatusPoller(mission.endpoint)
        try:
            supervisor.start()
            while not supervisor.watch():
                time.sleep(POLL_S)
                if not self._is_there():
                    raise MissionFailed(self._gone())
                status = observer.ask()
                if status is not None:
                    self.progress.show(status)
            supervisor.wait(15.0)
        finally:
            observer.close()
            supervisor.stop()
            supervisor.close()
            self._ended = {"exit_codes": supervisor.exit_codes(), "restarts": supervisor.restarts()}

    def _is_there(self) -> bool:
        """False once the run folder was removed or moved: nothing that is flown from then on can be kept."""
        try:
            return os.path.samestat(self._folder, self.out.stat())
        except OSError:
            return False

    def _gone(self) -> str:
        return f"the run folder {self.out} was removed or moved while the mission was flown: fly it again"

    def _compact(self) -> None:
        """Rewrite the journal of a mission that is over for keeping; its sizes are in `run.json`."""
        try:
            compacted = compact_log(self.out / "tmc.mcap", self.progress.work)
        except RecordError as error:  # all of it is there, in small chunks
            self.progress.note(f"the log stays as it was written: {error}")
        else:
            self._ended["compacted"] = {"before": compacted.before, "after": compacted.after}

    def _write_run(self, more: dict[str, Any]) -> None:
        """`run.json`: what was run, and resumed, with which versions, and how each process ended."""
        if not self._is_there():  # that is said
            return
        facts = {
            "command": self._begun.get("command", self.command),
            "resumed": [*self._begun.get("resumed", []), *([self.command] if self._begun else [])],
            "overfly": version("overfly"),
            "python": platform.python_version(),
            "platform": platform.platform(),
            "started": self._began_at.isoformat(timespec="seconds"),
            "seconds": round(time.monotonic() - self._start, 1),
        }
        try:
            disk.put(self.out / "run.json", (json.dumps(facts | more, indent=1) + "\n").encode(), sync=False)
        except OSError as error:
            self.progress.note(f"cannot write {self.out / 'run.json'}: {error.strerror}")


def command_line() -> str:
    """The command as the user typed it."""
    return shlex.join(["overfly", *sys.argv[1:]])
