"""`overfly bench journal`: the rate of the TMC's journal, the cost of a commit, and the bytes per UAV step.

The entries are those of a real flight. They go through the real journal into a real file, with commits as in the TMC:
at full speed, and at the pace of a flight of processes that was measured just before.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from statistics import median

from deploy import policy_spec, settings
from deploy.bench import bounds, rollout
from deploy.bench.row import Row
from deploy.run import lockstep
from deploy.run.mission import check
from tmc.analysis.invariants.check import check as check_log
from tmc.center.journal import Journal
from tmc.center.roster import Outbox
from tmc.kernel.config import Config, ConfigError, build
from tmc.kernel.world import World
from tmc.record.mcap.compact import compact_log
from tmc.record.reader import Log
from tmc.record.run_folder import run_files
from tmc.record.writer import LogWriter
from tmc.wire import process

NONE = "none"
CASES = (NONE, "process", "power")
"""Values of `journal.durability`, and `none`, the reference, in which nothing is committed."""
SYNCS = 50
"""Commits after each of which an fsync is timed."""


@dataclass
class Run:
    """One stretch of journalling: records and commits, wall time (s) and processor time (s)."""

    records: int = 0
    wall: float = 0.0
    cpu: float = 0.0
    commits: list[float] = field(default_factory=list)
    """Time (s) of each commit."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the bench."""
    parser.add_argument(
        "--dir", type=Path, default=Path(), help="folder on the disk to measure (default: the current one)"
    )
    parser.add_argument("--repeats", type=int, default=3, metavar="R", help="turns to take medians of (default: 3)")
    parser.add_argument("--seconds", type=float, default=2.0, metavar="S", help="length of each stretch (default: 2)")
    parser.add_argument(
        "--pace", type=float, default=0.0, metavar="P",
        help="flight records per second for the share of a core (default: those of a flight; a training has 60)",
    )  # fmt: skip
    settings.add_options(parser)


def measure(args: argparse.Namespace) -> list[Row]:
    """Fly once in processes and once in lock step, and journal that repeatedly; return one row per figure.

    Raises ConfigError.
    """
    bounds.stretches(args.repeats, args.seconds, 2 * len(CASES))
    bounds.number("--pace", args.pace, 0.0)
    if not args.dir.is_dir():
        raise ConfigError(f"--dir {args.dir} is not a folder: choose one on the disk that runs are written to")
    pilot = policy_spec.resolve("planner:greedy")
    world = check(build(policy_spec.mission_values(pilot, {"team.size": 10}, settings.chosen(args))))
    bounds.missions(world)
    with tempfile.TemporaryDirectory(prefix="overfly-bench-", dir=args.dir) as scratch:
        folder = Path(scratch)
        flown = folder / "flown"
        flown.mkdir()
        rate = rollout.fly_processes(world, None, flown, table=True, weigh=False).rate
        _print_progress(f"N = {world.config.team.size}: flown by processes, {rate:,.0f} UAV steps per second")
        outboxes = fly(world)
        pace = args.pace or rate * sum(map(records_in, outboxes)) / steps_of(world.config)
        rows = list(_speed(world, outboxes, pace, folder, args))
        rows.append(Row("journal", "fsync", 1e3 * median(fsyncs(world, outboxes, folder)), "ms, median"))
        return rows + list(_sizes(world, flown, folder))


def steps_of(config: Config) -> int:
    """Return the UAV steps of a mission."""
    return config.team.size * config.training.ticks * config.training.episodes


def records_in(outbox: Outbox) -> int:
    """Return the number of flight records among the entries."""
    return sum("record" in entry.values for entry in outbox.entries)


def fly(world: World) -> list[Outbox]:
    """Fly a mission in lock step; return the entries that the TMC journals."""
    outboxes: list[Outbox] = []
    lockstep.LockStep(world, None, outboxes.append).run()
    return [Outbox(entries=outbox.entries) for outbox in outboxes if outbox.entries]


# How fast, and at what cost.


def _speed(world: World, outboxes: list[Outbox], pace: float, folder: Path, args: argparse.Namespace) -> Iterator[Row]:
    """Yield rates and costs of each case; the cases take turns, so that the machine is the same for all."""
    full: dict[str, list[Run]] = {case: [] for case in CASES}
    paced: dict[str, list[Run]] = {case: [] for case in CASES}
    for _ in range(args.repeats):
        for case in CASES:
            full[case].append(stretch(world, case, outboxes, folder, args.seconds))
            paced[case].append(stretch(world, case, outboxes, folder, args.seconds, pace))
        rates = ", ".join(f"{case} {rate_of(full[case][-1]):,.0f}" for case in CASES)
        _print_progress(f"records per second: {rates}")
    base = [rate_of(run) for run in full[NONE]]
    for case in CASES:
        of_case = [rate_of(run) for run in full[case]]
        ratio = median(a / b for a, b in zip(of_case, base, strict=True))
        yield Row("journal", case, median(of_case), "records/s", median(base), ratio, "x no commits")
        share = median(run.cpu / run.wall for run in paced[case])
        yield Row("journal", f"{case} at {pace:,.0f} records/s", share, "share of a core")
        if case != NONE:
            commits = [seconds for run in paced[case] for seconds in run.commits]
            per_second = median(len(run.commits) / run.wall for run in paced[case])
            yield Row("journal", f"{case} commits", per_second, "commits/s")
            yield Row("journal", f"{case} commit", 1e3 * median(commits) if commits else None, "ms, median")


def rate_of(run: Run) -> float:
    """Return the records per second."""
    return run.records / run.wall


def stretch(
    world: World, case: str, outboxes: Iterable[Outbox], folder: Path, seconds: float, pace: float | None = None
) -> Run:
    """Journal for `seconds`, at `pace` records per second or at full speed."""
    run, journal = Run(), _journal(world, case, folder)
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        for outbox in cycle(outboxes):
            now = time.perf_counter() - begin
            if now >= seconds:
                break
            while pace is not None and run.records > pace * (time.perf_counter() - begin):
                _commit(run, journal, case)
                ahead = run.records / pace - (time.perf_counter() - begin)
                time.sleep(max(0.0, min(ahead, journal.due or ahead) if case != NONE else ahead))
            journal.take(outbox)
            run.records += records_in(outbox)
            _commit(run, journal, case)
        run.wall, run.cpu = time.perf_counter() - begin, time.process_time() - cpu
    finally:
        _remove(journal)
    return run


def _commit(run: Run, journal: Journal, case: str) -> None:
    """Commit when due, as the TMC's loop does, and time it."""
    if case != NONE and journal.due == 0.0:
        begin = time.perf_counter()
        journal.commit()
        run.commits.append(time.perf_counter() - begin)


def fsyncs(world: World, outboxes: list[Outbox], folder: Path) -> list[float]:
    """Return the times (s) of fsyncs, each after a commit, at the commit interval of the TMC."""
    journal, found = _journal(world, "process", folder), []
    number = os.open(journal.writer.active, os.O_RDONLY)
    try:
        for outbox, _ in zip(cycle(outboxes), range(SYNCS), strict=False):
            journal.take(outbox)
            time.sleep(world.config.journal.commit_interval)
            journal.commit()
            begin = time.perf_counter()
            os.fsync(number)
            found.append(time.perf_counter() - begin)
    finally:
        os.close(number)
        _remove(journal)
    return found


def _journal(world: World, case: str, folder: Path) -> Journal:
    durability = "process" if case == NONE else case
    config = build({"journal.durability": durability}, world.config)
    return Journal(Path(tempfile.mkdtemp(dir=folder)), World(config, world.map), "bench")


def _remove(journal: Journal) -> None:
    journal.writer.close()
    journal.writer.path.unlink()


# How much.


def _sizes(world: World, flown: Path, folder: Path) -> Iterator[Row]:
    """Yield the bytes per UAV step of the flight of processes, and the time of `overfly log check`."""
    alone = records_alone(world.config, flown, folder)
    steps = steps_of(world.config)
    for case, files in (("all topics of all files", [*run_files(flown).values()]), ("flight records alone", [alone])):
        compacted = [compact_log(file) for file in files]
        before, after = (sum(getattr(s, name) for s in compacted) / steps for name in ("before", "after"))
        yield Row("journal", f"{case}, compacted", after, "bytes/UAV step", before, after / before, "x as written")
    begin = time.perf_counter()
    result = check_log(flown)
    seconds = time.perf_counter() - begin
    if not result.good:
        raise RuntimeError(result.summary())
    yield Row("journal", f"log check of {steps:,} UAV steps", seconds, "s")


def records_alone(config: Config, flown: Path, folder: Path) -> Path:
    """Write a log with only the flight records of a run, in as many commits; return its path."""
    path = folder / "tmc.mcap"
    with LogWriter(path, "tmc", config.journal, {}) as log:
        due = 0
        for raw in Log(run_files(flown)["tmc"]).raw():
            if raw.schema == "overfly.FlightRecord":
                if raw.log_time >= due:
                    log.flush()
                    due = raw.log_time + round(1e9 * config.journal.commit_interval)
                log.put(raw.topic, raw.data, raw.log_time, raw.publish_time, raw.sequence)
    return path


def _print_progress(text: str) -> None:
    process.tell(text, prefix="")
