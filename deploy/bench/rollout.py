"""`overfly bench rollout`: N UAV processes against the lock-step fleet, in turns, so that the machine is the same.

A rate covers the flight alone, by the log: the UAV steps between the first final tick and the last.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from deploy import policy_spec, settings
from deploy.bench import bounds
from deploy.bench.row import Row
from deploy.commands.evaluate import team_sizes
from deploy.run import lockstep, plan
from deploy.run.mission import check
from deploy.run.progress import StatusPoller
from deploy.run.supervisor import Supervisor
from tmc.center.journal import Journal
from tmc.kernel.config import Config, build, flat
from tmc.kernel.world import World
from tmc.record.mcap.parser import Message as LoggedMessage
from tmc.record.overfly_pb2 import TeamMetrics, UavStatus
from tmc.record.reader import Log, decode
from tmc.record.run_folder import RunFolder, run_files
from tmc.record.schemas import foxglove
from tmc.wire import process

TRANSPORTS = {"table": (True,), "beacons": (False,), "both": (True, False)}
"""Whether the UAVs share a table of tracks, for each value of `--transport`."""
LIMITS = {"private": 35.0, "memory": 4096.0, "start": 15.0}
"""Limits of a team of 100: MiB of private memory per UAV, MiB in total, s until the first tick is flown."""
MISSION_S = 0.5
"""Least time (s) of a mission of processes."""
POLL_S = 0.05
"""Interval (s) at which the processes are checked."""


@dataclass(frozen=True)
class Memory:
    """Memory (MiB) while flying.

    `private`: private memory of the largest UAV process. `total`: of all processes, shared pages counted once.
    `roles`: `total` by role, all UAVs together.
    """

    private: float
    total: float
    roles: dict[str, float]


@dataclass(frozen=True)
class RunData:
    """One mission.

    `rate`: UAV steps per second. `start`: s from the start to the first tick. `waits`: share of time that UAVs waited
    for peers. `beacons`: beacons per UAV step.
    """

    rate: float
    start: float
    waits: float | None
    beacons: float
    memory: Memory | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the bench."""
    parser.add_argument(
        "--who", default="planner:greedy", help="policy file, run folder or planner (default: %(default)s)"
    )
    parser.add_argument("--actors", default="1,2,3,10,50,100", metavar="N[,N...]", help="default: %(default)s")
    parser.add_argument("--repeats", type=int, default=3, metavar="R", help="turns to take medians of (default: 3)")
    parser.add_argument(
        "--transport", choices=TRANSPORTS, default="table", help="how UAVs share their positions (default: table)"
    )
    settings.add_options(parser, actors=False)


def measure(args: argparse.Namespace) -> list[Row]:
    """Fly all missions; return one row per figure. Raises ConfigError."""
    pilot = policy_spec.resolve(args.who)
    values = policy_spec.mission_values(pilot, settings.chosen(args))
    bounds.number("--repeats", args.repeats, 1, MISSION_S)
    sizes = [n for n in team_sizes(args.actors) if n is not None]
    worlds = [check(build({**values, "team.size": n}), pilot.policy) for n in sizes]
    for world in worlds:
        bounds.missions(world, 2 * args.repeats)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="overfly-bench-") as scratch:
        for world in worlds:
            rows += _size(world, pilot.policy, args, Path(scratch))
    return rows


def _size(world: World, policy: bytes | None, args: argparse.Namespace, scratch: Path) -> list[Row]:
    """Fly one team size `--repeats` times: the fleet, then the processes over each transport; return the rows."""
    transports = TRANSPORTS[args.transport]
    fleet: list[RunData] = []
    teams: dict[bool, list[RunData]] = {table: [] for table in transports}
    for repeat in range(args.repeats):
        fleet.append(fly_fleet(world, policy, _folder(scratch)))
        for table in transports:
            teams[table].append(fly_processes(world, policy, _folder(scratch), table=table, weigh=repeat == 0))
        last = ", ".join(f"{flown[-1].rate:,.0f}" for flown in teams.values())
        speeds = f"fleet {fleet[-1].rate:,.0f}, processes {last} UAV steps per second"
        _print_progress(f"N = {world.config.team.size}: {speeds}")
    rates = [f.rate for f in fleet]
    rows = [Row("rollout", f"N={world.config.team.size} one process", median(rates), "UAV steps/s")]
    for table, flown in teams.items():
        rows += _rows(world.config, "table" if table else "beacons", flown, rates)
    return rows


def _rows(config: Config, transport: str, flown: list[RunData], fleet: list[float]) -> Iterator[Row]:
    case, memory = f"N={config.team.size} {transport}", flown[0].memory
    rates = [f.rate for f in flown]
    ratio = median(a / b for a, b in zip(rates, fleet, strict=True))
    yield Row("rollout", case, median(rates), "UAV steps/s", median(fleet), ratio, "x one process")
    waits = [f.waits for f in flown if f.waits is not None]
    yield Row("rollout", f"{case} waits", median(waits) if waits else None, "share of time")
    yield Row("rollout", f"{case} beacons", median(f.beacons for f in flown), "beacons/UAV step")
    figures: dict[str, tuple[float | None, str]] = {
        "private": (memory.private if memory else None, "MiB, largest UAV"),
        "memory": (memory.total if memory else None, "MiB in total"),
        "start": (median(f.start for f in flown), "s to the first tick"),
    }
    for name, (value, unit) in figures.items():
        limit = LIMITS[name]
        yield Row("rollout", f"{case} {name}", value, unit, limit, value and value / limit, "of the limit")


def _print_progress(text: str) -> None:
    process.tell(text, prefix="")


def _folder(scratch: Path) -> Path:
    return Path(tempfile.mkdtemp(dir=scratch))


def fly_fleet(world: World, policy: bytes | None, out: Path) -> RunData:
    """Fly the mission in this process, with the same journal: the reference."""
    start = time.time_ns()
    journal = Journal(out, world, "bench")
    try:
        lockstep.LockStep(world, policy, journal.take).run()
    finally:
        journal.writer.close()
    return _read(out, world.config, start)


def fly_processes(world: World, policy: bytes | None, out: Path, *, table: bool, weigh: bool) -> RunData:
    """Fly the mission in processes; `weigh`: measure their memory once, half way."""
    config, memory, start = world.config, None, time.time_ns()
    half = config.training.episodes * config.training.ticks // 2
    with started(config, policy, out, table=table) as (supervisor, observer):
        while not supervisor.watch():
            time.sleep(POLL_S)
            status = observer.ask()
            if weigh and memory is None and status is not None and status.ticks > half:
                memory = weigh_all(supervisor.pids())
        supervisor.wait(15.0)
    return _read(out, config, start, memory)


@contextmanager
def started(
    config: Config, policy: bytes | None, out: Path, *, table: bool = True
) -> Iterator[tuple[Supervisor, StatusPoller]]:
    """Start the processes of a mission in `out`; yield supervisor and poller; stop all at the end of the block."""
    RunFolder(out).config.write_text(json.dumps(flat(config)), "utf-8")
    file = None if policy is None else out / "flown.onnx"
    if file is not None and policy is not None:
        file.write_bytes(policy)
    mission = plan.make(config, out, policy=file, table=table)
    supervisor = Supervisor(mission, out, config.training.threads, _print_progress)
    observer = StatusPoller(mission.endpoint)
    try:
        supervisor.start()
        yield supervisor, observer
    finally:
        observer.close()
        supervisor.stop()
        supervisor.close()


def weigh_all(pids: Mapping[str, int]) -> Memory | None:
    """Return the memory of these processes and of this one; None if the system does not report it, or one has ended."""
    try:
        rolls = {name: _rollup(pid) for name, pid in {**pids, "supervisor": os.getpid()}.items()}
    except OSError:
        return None
    uavs = [roll for name, roll in rolls.items() if name.startswith("uav-")]
    if not uavs:
        return None
    private = max(roll["Private_Clean"] + roll["Private_Dirty"] for roll in uavs)
    roles: defaultdict[str, float] = defaultdict(float)
    for name, roll in rolls.items():
        roles["uavs" if name.startswith("uav-") else name] += roll["Pss"] / 1024
    return Memory(private / 1024, sum(roles.values()), dict(roles))


def own() -> float | None:
    """Return the PSS (MiB) of this process; None if the system does not report it."""
    try:
        return _rollup(os.getpid())["Pss"] / 1024
    except OSError:
        return None


def _rollup(pid: int) -> dict[str, int]:
    """Return the memory (KiB) by kind, from /proc/PID/smaps_rollup."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text("utf-8", "replace")
    return {name: int(size) for name, size in re.findall(r"^(\w+):\s+(\d+) kB$", text, re.MULTILINE)}


def _read(out: Path, config: Config, start: int, memory: Memory | None = None) -> RunData:
    """Read the figures of a mission from its log; `start`: ns of the wall clock."""
    files = run_files(out)
    times, beacons = [], 0
    for raw in Log(files["tmc"]).raw():
        if raw.topic == "/tmc/metrics":
            times.append((raw.log_time, decode(raw, TeamMetrics).elapsed))
        elif raw.topic == "/log":
            count = re.search(r"\bBeacon ([0-9]+)", decode(raw, foxglove("Log").Log).message)
            beacons += int(count[1]) if count else 0
    steps = config.team.size * config.training.ticks * config.training.episodes
    seconds = times[-1][1] - times[0][1]
    uavs = [path for name, path in files.items() if name.startswith("uav-")]
    return RunData(
        steps / seconds if seconds else math.nan,
        (times[0][0] - start) / 1e9,
        _waits(uavs, times[0][0]),
        beacons / steps,
        memory,
    )


def _waits(files: list[Path], begin: int) -> float | None:
    """Return the mean share of time that UAVs waited for peers, by the last status of each; None without one."""
    shares = []
    for file in files:
        last: LoggedMessage | None = None
        for raw in Log(file).raw():
            if raw.schema == "overfly.UavStatus":
                last = raw
        if last is not None and last.log_time - begin > 2e8:  # a status in the first moments means nothing
            shares.append(decode(last, UavStatus).waited / ((last.log_time - begin) / 1e9))
    return sum(shares) / len(shares) if shares else None
