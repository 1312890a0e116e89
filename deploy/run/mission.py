"""Runs a mission from its config to its run folder: as processes or in lock step."""

from __future__ import annotations

import json
import os
import platform
import shlex
import signal
import sys
import time
from collections.abc import Callable
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
from tmc.kernel import files, forecast
from tmc.kernel.config import Config, ConfigError, flat
from tmc.kernel.files import plain
from tmc.kernel.policy import FlightError, check_view, view_shape
from tmc.kernel.text import suggestion
from tmc.kernel.uncertainty import lower_bound
from tmc.kernel.world import World, world_of_run
from tmc.record import disk
from tmc.record.errors import RecordError
from tmc.record.mcap.compact import compact_log
from tmc.record.reader import Log
from tmc.record.run_folder import RunFolder
from tmc.wire import capacity, process

POLL_S = 0.1
"""Interval (s) at which the processes are checked."""


def new_folder(out: Path | None, name: str) -> Path:
    """Make and return the run folder, which must be empty; by default `runs/<name>-<time>`. Raises ConfigError."""
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
    """Return the lower bound of eq. (6) in scenario II from a visited map, which no team can beat; otherwise 0."""
    config = world.config
    if config.scenario != 2 or config.world.initial_map != "visited":
        return 0.0
    return lower_bound(world.alpha, config.team.size, config.training.ticks)


def check(config: Config, policy: bytes | None = None, name: str = "the policy") -> World:
    """Check all settings of a mission, and its policy; return its world. Raises ConfigError, PolicyError, MapError.

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
    """Raise ConfigError or PolicyError if a mission cannot be flown in a world."""
    config = world.config
    learning = policy is None and not policy_spec.is_planner(config)
    if policy is not None:
        policy_spec.require_policy(policy, world, name)
    elif learning:
        check_view(config, view_shape(config, world.grid))
    capacity.check(world, learning=learning)


def check_training(config: Config, say: Callable[[str], None] = process.tell) -> None:
    """Raise ConfigError where nothing would be learned in a whole mission; and say what else will not be done."""
    if policy_spec.is_planner(config):
        return
    if idle := forecast.idle(config):
        raise ConfigError(idle)
    for sentence in forecast.remarks(config):
        say(sentence)


def needs(config: Config, policy: bytes | None) -> tuple[str, ...]:
    """Return the extras that a mission needs: without a fixed policy or a planner, it needs the learner's."""
    return () if policy is not None or policy_spec.is_planner(config) else (extras.LEARNER,)


def flown_policy(out: Path) -> Path:
    """Return the path of the fixed policy of a run."""
    return RunFolder(out).fixed_policy


def require_settings(out: Path) -> Config:
    """Return the settings that a run in `out` was started with. Raises ConfigError if `config.json` was edited."""
    journal = RunFolder(out).existing_journal()
    if journal is None:
        raise ConfigError(f"{out} holds no journal (tmc.mcap): --resume takes the folder of a run that was begun")
    settings = settings_of(out, journal)
    if settings.edited:
        keys = ", ".join(settings.edited)
        fix = "put it back, or remove the file and the log's settings are used; other settings need a run of their own"
        raise ConfigError(f"{RunFolder(out).config} was edited since the run was begun, in {keys}: {fix}")
    return settings.config


def interrupted(out: Path, say: Callable[[str], None] = process.tell) -> tuple[World, bytes | None]:
    """The world and the fixed policy of a run that was begun in `out`, to go on with it; raises ConfigError.

    `say` takes a sentence on what is damaged.
    """
    config = require_settings(out)
    journal = RunFolder(out).existing_journal()
    assert journal is not None
    with disk.open_locked(journal, "rb"):
        log = Log(journal)  # no process writes it
    if log.damage and not log.still_open:
        text = f"{log.damage}: the run goes on from before that; the damaged file is kept as {journal.name}.damaged-*"
        say(f"{text}, and `overfly log recover` says what else is in it")
    file = flown_policy(out)
    policy = files.read_bytes(file) if file.exists() else None
    world = world_of_run(config, out)
    _check(world, policy, str(file))
    if attachments(journal).get("map.csv", world.map.csv()) != world.map.csv():
        copy = RunFolder(out).map_copy
        name = copy if copy.exists() else config.world.map
        raise ConfigError(f"the map {name} has changed since the run was begun: put it back as it was")
    if log.metadata().get("run") == lockstep.RUN and policy is None and not policy_spec.is_planner(config):
        raise ConfigError(f"{out} was trained in lock step, which leaves no checkpoint to go on from: run it again")
    return world, policy


def keep_settings(out: Path, world: World, policy: bytes | None) -> Path | None:
    """Write `config.json`, a user's map and the fixed policy, before the run starts; return the policy's path.

    All are synced at once, because after a power cut no journal has a copy yet.
    """
    disk.write_atomically(RunFolder(out).config, (json.dumps(flat(world.config), indent=1) + "\n").encode(), sync=True)
    if world.map.source:
        disk.write_atomically(RunFolder(out).map_copy, world.map.source.encode(), sync=True)
    if policy is None:
        return None
    file = flown_policy(out)
    file.parent.mkdir(parents=True, exist_ok=True)
    disk.write_atomically(file, policy, sync=True)
    return file


def finished(out: Path) -> bool:
    """Return whether all processes of the run in `out` ended in order."""
    codes = _run_facts(out).get("exit_codes", {})
    return set(codes.values()) == {0} and RunFolder(out).journal.exists()


def _run_facts(out: Path) -> dict[str, Any]:
    """Return the contents of `run.json`; an empty dict if it is missing or damaged."""
    try:
        facts = json.loads(files.read_text(RunFolder(out).outcome))
    except (OSError, ValueError):
        return {}
    return facts if isinstance(facts, dict) else {}


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
        self._begun, self._began_at, self._start = _run_facts(out), datetime.now(UTC), time.monotonic()
        self._ended: dict[str, Any] = {}
        self._folder = out.stat()
        self._write_run(self._ended)

    def run(self, *, in_one_process: bool) -> int:
        """Fly it, and say why when it did not come to its end; returns the exit code. Raises as `fly` otherwise."""
        try:
            self.fly(in_one_process=in_one_process)
        except MissionFailed as failed:
            self.progress.note(str(failed))
            return process.FAILED
        except KeyboardInterrupt as stopped:
            return 128 + (stopped.args[0] if stopped.args else signal.SIGINT)
        return process.DONE

    def fly(self, *, in_one_process: bool) -> None:
        """Fly it to its end. What it left is in the run folder either way.

        Raises MissionFailed; KeyboardInterrupt, once all processes have ended in order; RecordError when the journal
        cannot be written.
        """
        try:
            self._fly_and_compact(in_one_process=in_one_process)
        except RecordError:
            if self._is_there():
                raise
            raise MissionFailed(self._gone()) from None
        except (MissionFailed, FlightError) as failed:
            which = f" (policy 1 is {self.flies})" if self.policy and "policy 1" in str(failed) else ""
            raise MissionFailed(f"{failed}{which}") from None
        except KeyboardInterrupt:
            self.progress.note(f"stopped; what was flown is in {self.out}")
            raise

    def _fly_and_compact(self, *, in_one_process: bool) -> None:
        try:
            if in_one_process:
                lockstep.run(self.world, self.out, self.policy, self.progress)
                self._ended = {"exit_codes": {lockstep.RUN: process.DONE}}
            else:
                self._fly()
            self._compact()
        finally:
            self._write_run(self._ended)  # first of all: what is said goes to a terminal that may be gone
            self.progress.clear()

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
        """Return False once the run folder was removed or moved, since the flight can no longer be logged."""
        try:
            return os.path.samestat(self._folder, self.out.stat())
        except OSError:
            return False

    def _gone(self) -> str:
        return f"the run folder {self.out} was removed or moved while the mission was flown: fly it again"

    def _compact(self) -> None:
        """Compact the journal of a finished mission; its sizes go to `run.json`."""
        try:
            compacted = compact_log(RunFolder(self.out).journal, self.progress.work)
        except RecordError as error:  # the log is complete, in small chunks
            self.progress.note(f"the log was not compacted: {error}")
        else:
            self._ended["compacted"] = {"before": compacted.before, "after": compacted.after}

    def _write_run(self, more: dict[str, Any]) -> None:
        """Write `run.json`: the commands that ran and resumed it, the versions, and how each process ended."""
        if not self._is_there():  # which is reported
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
            text = json.dumps(facts | more, indent=1) + "\n"
            disk.write_atomically(RunFolder(self.out).outcome, text.encode(), sync=False)
        except OSError as error:
            self.progress.note(f"cannot write {RunFolder(self.out).outcome}: {error.strerror}")


def command_line() -> str:
    """Return the command as the user typed it."""
    return shlex.join(["overfly", *sys.argv[1:]])
