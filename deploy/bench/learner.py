"""`overfly bench learner`: the learner of a running mission against the textbook loop, in speed and in results.

The mission is the paper's, with a replay memory of 1,500 transitions and a target copy every 75 updates. Each
transition is drawn 6.4 times before theta- changes, and 15 % of them are new then, as with the paper's 100,000 and
5,000; so the target cache has as many hits. The memory is full after seconds instead of half an hour.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from deploy import settings
from deploy.bench import bounds
from deploy.bench.replay import fill
from deploy.bench.rollout import started, weigh_all
from deploy.bench.row import Row
from deploy.run import helper, plan
from deploy.run.mission import check
from deploy.run.progress import StatusPoller
from deploy.run.supervisor import Supervisor
from tmc.center.replay import Replay
from tmc.kernel import observation
from tmc.kernel.config import Config, ConfigError, flat
from tmc.kernel.world import World
from tmc.record.overfly_pb2 import LearnerMetrics
from tmc.record.reader import Log
from tmc.record.run_folder import run_files
from tmc.wire import messages, process
from tmc.wire.messages import Minibatch

if TYPE_CHECKING:
    from learner.batching import Batch

SCALED = {"replay.capacity": 1500, "dqn.target_episodes": 0, "dqn.target_updates": 75}
MISSION = {**SCALED, "training.episodes": 1_000_000}
"""The bench stops the mission before its end."""
POLL_S = 0.05
"""Interval (s) at which the processes are checked."""
TUNED = "in the learner's environment"
"""Freed memory is kept and idle threads sleep, as in the learner. This row shows the effect of that alone."""
CLOCK_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
CPU_UNIT = "ms of processor time per update"


@dataclass(frozen=True)
class Learned:
    """A stretch of a mission.

    `rate`: updates per second. `ticks`: ticks per second. `start`: s from the start of the mission to its first update.
    `memory`: MiB of all processes. `idle`: the learner's idle share. `cpu`: ms of processor time per update, by role.
    """

    rate: float
    ticks: float
    start: float
    memory: float | None
    idle: float | None
    cpu: dict[str, float]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the bench."""
    parser.add_argument("--repeats", type=int, default=3, metavar="R", help="turns to take medians of (default: 3)")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="S", help="length of each stretch (default: 10)")
    parser.add_argument(
        "--threads", type=int, default=2, metavar="N", help="threads of the learner and of the loop (default: 2)"
    )
    parser.add_argument(
        "--steps", type=int, default=300, metavar="U", help="updates whose results are compared (default: 300)"
    )
    settings.add_options(parser)


def measure(args: argparse.Namespace) -> list[Row]:
    """Run the textbook loop and a mission in turns, then compare results; return one row per figure.

    Raises ConfigError.
    """
    bounds.stretches(args.repeats, args.seconds, 3)
    bounds.number("--steps", args.steps, 0, 1e-3)
    values = {**MISSION, "training.threads": args.threads, **settings.chosen(args)}
    world = check(settings.config_for("paper", values))
    bounds.training(world, warm_up(world.config))
    textbook: list[float] = []
    tuned: list[float] = []
    flown: list[Learned] = []
    with tempfile.TemporaryDirectory(prefix="overfly-bench-") as scratch:
        for _ in range(args.repeats):
            textbook.append(reference_loop(world.config, args.seconds, "textbook"))
            flown.append(fly(world, args.seconds, Path(tempfile.mkdtemp(dir=scratch))))
            tuned.append(reference_loop(world.config, args.seconds, "learner"))
            print_progress(
                f"textbook loop {textbook[-1]:.1f}, {TUNED} {tuned[-1]:.1f}, learner {flown[-1].rate:.1f} updates/s"
            )
    rows = list(_rows(world.config, flown, textbook, tuned))
    return rows + (list(compare(world, args.steps)) if args.steps else [])


def _rows(config: Config, flown: list[Learned], textbook: list[float], tuned: list[float]) -> Iterator[Row]:
    case, rates = f"N={config.team.size} threads={config.training.threads}", [f.rate for f in flown]
    for name, reference in (("textbook loop", textbook), (f"textbook loop {TUNED}", tuned)):
        ratio = median(a / b for a, b in zip(rates, reference, strict=True))
        yield Row("learner", f"{case}", median(rates), "updates/s", median(reference), ratio, f"x {name}")
    yield from shares("learner", case, flown)


def shares(bench: str, case: str, flown: list[Learned]) -> Iterator[Row]:
    """Yield the learner's idle share, and the processor time per update by role."""
    idle = [f.idle for f in flown if f.idle is not None]
    yield Row(bench, f"{case} idle", median(idle) if idle else None, "share of time")
    for role in flown[0].cpu:
        yield Row(bench, f"{case} {role}", median(f.cpu[role] for f in flown), CPU_UNIT)


def print_progress(text: str) -> None:
    """Print a line of progress to stderr."""
    process.tell(text, prefix="")


def reference_loop(config: Config, seconds: float, name: str) -> float:
    """Return the updates per second of `learner.reference` in a separate process, with the environment of `name`."""
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        file.write(json.dumps(flat(config)))
        file.flush()
        env = plan.environment(name, config.training.threads)
        env |= {"OMP_WAIT_POLICY": "PASSIVE"} if name == "learner" else {}
        words = ("learner.reference", "--config", file.name, "--seconds", seconds)
        return float(helper.output_of(helper.start(*words, env=env)))


def fly(world: World, seconds: float, out: Path) -> Learned:
    """Fly a mission of processes; measure it once the replay memory is full and theta- has changed."""
    config = world.config
    warm = warm_up(config)
    begun = time.monotonic()
    with started(config, None, out) as (supervisor, observer):
        first, _ = _wait(supervisor, observer, updates=1)
        began, since = _wait(supervisor, observer, updates=warm)
        cpu = _cpu(supervisor.pids())
        ended, until = _wait(supervisor, observer, until=began + seconds)
        span, updates = ended - began, until.updates - since.updates
        spent = {role: 1e3 * (s - cpu[role]) / updates for role, s in _cpu(supervisor.pids()).items()}
        memory = weigh_all(supervisor.pids())
    ticks = (until.ticks - since.ticks) / span
    total = memory.total if memory else None
    return Learned(updates / span, ticks, first - begun, total, _idle(out, seconds), spent)


def warm_up(config: Config) -> int:
    """Return the updates after which the memory is full and theta- has changed."""
    return config.replay.capacity // config.team.size + config.dqn.target_updates


def _wait(
    supervisor: Supervisor, observer: StatusPoller, updates: int = 0, until: float = 0.0
) -> tuple[float, messages.Status]:
    """Wait for `updates`, and until `until` (s of the monotonic clock); return (time, status). Raises ConfigError."""
    pace = bounds.Pace("the updates before the measurement:", updates)
    while True:
        if supervisor.watch():
            raise ConfigError("the mission was over before it was measured: give it more --episodes or --ticks")
        status, now = observer.ask(), time.monotonic()
        if status is not None and status.updates >= updates and now >= until:
            return now, status
        if status is not None and updates > 1:
            pace.check(status.updates)
        time.sleep(POLL_S)


def _cpu(pids: Mapping[str, int]) -> dict[str, float]:
    """Return the processor time (s) so far, by role: learner, TMC, and all UAVs together."""
    spent = dict.fromkeys(("learner", "tmc", "uavs"), 0.0)
    for name, pid in pids.items():
        fields = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace").rpartition(")")[2].split()
        role = next((role for role in ("tmc", "learner") if name.endswith(role)), "uavs")  # each with its forkserver
        spent[role] += (int(fields[11]) + int(fields[12])) / CLOCK_TICKS_PER_S
    return spent


def _idle(out: Path, seconds: float) -> float | None:
    """Return the mean idle share that the learner logged in the last `seconds`."""
    path = run_files(out).get("learner")
    logged = [*Log(path).messages(LearnerMetrics)] if path else []
    shares = [metrics.idle_share for metrics in logged if metrics.wall > logged[-1].wall - seconds]
    return sum(shares) / len(shares) if shares else None


def compare(world: World, steps: int) -> Iterator[Row]:
    """Compare the gradients of `steps` updates with the textbook loop's, on minibatches of random flights."""
    from learner import reference  # noqa: PLC0415  torch only for this bench

    replay = Replay(world, observation.ObservationBuilder(world))
    fill(replay)
    found, case = reference.departures(world.config, _batches(replay, steps)), f"{steps:,} steps"
    ratio = found.learner / found.textbook if found.textbook else None
    yield Row("learner", case, found.learner, "of the gradient", found.textbook, ratio, "x textbook loop's rounding")
    yield Row(
        "learner", f"{case}, worst weight", found.of_bound, "of the bound", 1.0, found.of_bound, "x float32's bound"
    )


def _batches(replay: Replay, count: int) -> Iterator[Batch]:
    from learner.batching import BatchBuilder  # noqa: PLC0415  torch only for this bench

    builder, pace = BatchBuilder(replay.observer), bounds.Pace("--steps", count)
    for number in range(count):
        pace.check(number)
        if number % 200 == 199:
            print_progress(f"{number + 1:,} of {count:,} steps compared")
        s = replay.sample(number, replay.world.config.dqn.batch_size)
        v = s.views
        yield builder.build(
            Minibatch(
                request=number,
                episodes=0,
                ticks=0,
                cells=v.cells,
                peers=v.peers,
                u=v.u,
                action=s.action,
                reward=s.reward,
                discount=s.discount,
                allowed=s.allowed,
                index=s.index,
            )
        )
