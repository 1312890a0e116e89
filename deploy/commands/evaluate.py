"""`overfly evaluate WHO...`: policies and planners side by side, many seeds each, in lock step."""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, dataclass
from statistics import mean, stdev
from typing import Any

from deploy import extras, policy_spec, settings
from deploy.run import lockstep, pool
from deploy.run.mission import bound_of, check
from tmc.center.roster import Outbox
from tmc.kernel.config import Config, ConfigError, build
from tmc.kernel.policy import FlightError
from tmc.kernel.roadmap import builtin_maps, load_map
from tmc.kernel.text import printable
from tmc.kernel.world import World
from tmc.wire import process
from tmc.wire.process import FAILED

FIRST_SEED = 1_000_000
"""Seeds of an evaluation start here, far from those that people train with."""
WORLD = ("scenario", "team.size", "team.sensing_range", "comms.period", "comms.phase", "training.ticks")
"""What a run brings along for everybody that it is compared with, beside `world.*`."""
T_975 = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131,
    2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip
"""97.5 % points of Student's t for 1 to 30 degrees of freedom."""


@dataclass(frozen=True)
class EpisodeState:
    """One mission: WHO, N, the seed, eq. (6) a road cell, blocked moves by another UAV and in all, wall seconds."""

    who: str
    actors: int
    seed: int
    uncertainty: float
    bound: float
    collisions: int
    blocked: int
    seconds: float


@dataclass(frozen=True)
class Row:
    """A line of the table: means over seeds; `interval` is half the width of the 95 % interval of the mean."""

    who: str
    actors: int
    seeds: int
    uncertainty: float
    interval: float
    times_bound: float
    collisions: float
    blocked: float
    seconds: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("who", nargs="+", help="policy files, run folders, planner:random, planner:random-road, ...")
    parser.add_argument("--actors", default=None, metavar="N[,N...]", help="team sizes (default: the mission's)")
    parser.add_argument("--seeds", type=int, default=10, metavar="S", help="missions each (default: 10)")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED, metavar="S", help="default: %(default)s")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="J", help="processes to use")
    parser.add_argument("--json", action="store_true", help="print one line of JSON a row")
    settings.add_options(parser, actors=False, refused=("--seed", "--episodes"))


def main(args: argparse.Namespace) -> int:
    """Fly them all, then print the table."""
    extras.require()
    if args.seeds < 1 or args.jobs < 1:
        raise ConfigError("--seeds and --jobs must be 1 or more")
    if args.seed is not None or args.episodes is not None:
        raise ConfigError("evaluate flies one episode a seed: choose them with --seeds and --first-seed")
    work = list(missions(args))
    try:
        rows = table(fly_all(work, args.jobs))
    except FlightError as error:
        process.tell(str(error))
        return FAILED
    if args.json:
        for row in rows:
            values = asdict(row).items()  # nan is no JSON
            print(json.dumps({k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values}))
    else:
        print(text(rows, work[0][1]))
    return 0


def team_sizes(listed: str | None) -> list[int | None]:
    """The team sizes of `--actors 1,3,10`; [None] for the mission's own."""
    try:
        return [None] if listed is None else [*dict.fromkeys(int(n) for n in listed.split(","))]
    except ValueError:
        raise ConfigError(f"--actors {listed} is no list of numbers: write for example --actors 1,3,10") from None


def missions(args: argparse.Namespace) -> Iterator[tuple[str, Config, bytes | None]]:
    """(WHO, config, policy) of every mission, checked before the first one flies."""
    pilots = [policy_spec.resolve(name) for name in dict.fromkeys(args.who)]
    shared = shared_world(pilots, {*settings.chosen(args), *(["team.size"] if args.actors else [])})
    for pilot in pilots:
        for n in team_sizes(args.actors):
            size = {} if n is None else {"team.size": n}
            config = build(policy_spec.mission_values(pilot, shared, settings.chosen(args), size))
            check(config, pilot.policy, pilot.name)
            for seed in range(args.first_seed, args.first_seed + args.seeds):
                yield pilot.name, build({"training.seed": seed}, config), pilot.policy


def shared_world(pilots: list[policy_spec.PolicySpec], chosen: Collection[str] = ()) -> dict[str, Any]:
    """The world of the run folders among WHO, for everybody in the table; ConfigError when they do not agree on what
    is not `chosen` for all of them."""
    worlds = [{k: v for k, v in p.values.items() if k in WORLD or k.startswith("world.")} for p in pilots]
    worlds = [world for world in worlds if world]
    for world in worlds[1:]:
        differ = [key for key in world if key not in chosen and not _same(key, world[key], worlds[0].get(key))]
        if differ:
            raise ConfigError(f"the runs differ in {', '.join(differ)}: set it for all of them with --set, or apart")
    return worlds[0] if worlds else {}


def _same(key: str, value: Any, other: Any) -> bool:
    """Whether two runs agree in a setting: of their maps, each of which lies in its run's folder, the text counts."""
    if key == "world.map" and value != other and not {value, other} & {*builtin_maps()}:
        return load_map(value).source == load_map(other).source
    return bool(value == other)


def fly_one(mission: tuple[str, Config, bytes | None]) -> EpisodeState:
    """Fly one mission in lock step; nothing is logged."""
    name, config, policy = mission
    world = World(config)
    start = time.perf_counter()
    fleet = lockstep.LockStep(world, policy, _forget)
    try:
        fleet.run()
    except FlightError as error:
        raise FlightError(f"{name}, seed {config.training.seed}: {error}") from None
    station, cells = fleet.station, world.law.cells.size
    seconds = time.perf_counter() - start
    return EpisodeState(
        name, config.team.size, config.training.seed, station.episode_uncertainty / cells, bound_of(world) / cells,
        station.blocked_by_uav, station.blocked, seconds,
    )  # fmt: skip


def _forget(_outbox: Outbox) -> None:
    """An evaluation keeps no journal."""


def fly_all(work: list[tuple[str, Config, bytes | None]], jobs: int) -> list[EpisodeState]:
    """Fly all missions on `jobs` processes, with progress."""
    if jobs == 1 or len(work) == 1:
        return list(_progress(map(fly_one, work), len(work)))
    return list(_progress(pool.call_each(fly_one, work, jobs), len(work)))


def _progress(flights: Iterable[EpisodeState], total: int) -> Iterator[EpisodeState]:
    start, said = time.monotonic(), time.monotonic()
    for done, flight in enumerate(flights, 1):
        now = time.monotonic()
        if now - said > 2 and done < total:
            left = (now - start) / done * (total - done)
            process.tell(f"{done}/{total} missions · {done / (now - start):.1f}/s · {left:.0f} s left", prefix="")
            said = now
        yield flight


def table(flights: list[EpisodeState]) -> list[Row]:
    """One row for each WHO and N, in the order flown."""
    groups: dict[tuple[str, int], list[EpisodeState]] = {}
    for flight in flights:
        groups.setdefault((flight.who, flight.actors), []).append(flight)
    return [_row(who, n, group) for (who, n), group in groups.items()]


def _row(name: str, n: int, group: list[EpisodeState]) -> Row:
    def average(field: str) -> float:
        return float(mean(getattr(f, field) for f in group))

    u, bound = average("uncertainty"), average("bound")
    return Row(
        name, n, len(group), u, half_width([f.uncertainty for f in group]), u / bound if bound else math.nan,
        average("collisions"), average("blocked"), sum(f.seconds for f in group),
    )  # fmt: skip


def half_width(values: list[float]) -> float:
    """Half the width of the 95 % interval of the mean, by Student's t; nan for a single value."""
    n = len(values)
    if n < 2:
        return math.nan
    t = T_975[n - 2] if n - 2 < len(T_975) else 1.96
    return t * stdev(values) / math.sqrt(n)


def text(rows: list[Row], config: Config) -> str:
    """The table for a person."""
    scenario, ticks = config.scenario, config.training.ticks
    lines = [
        f"Mean uncertainty a road cell: {ticks:,} ticks, scenario {scenario}, T_u = {config.T_u}, "
        f"{printable(config.world.map)};",
        f"mean of {rows[0].seeds} seeds with its 95 % interval. x bound: against a lower bound that no team can beat.",
        "blocked: moves refused in a mission; collisions: those of them that another UAV stood in the way of.",
        "",
        f"{'who':<32} {'N':>3} {'uncertainty':>18} {'x bound':>8} {'collisions':>11} {'blocked':>8} {'seconds':>8}",
    ]
    for r in rows:
        times = "-" if math.isnan(r.times_bound) else f"{r.times_bound:.3f}"
        spread = "" if math.isnan(r.interval) else f" ± {r.interval:.4f}"
        who = printable(r.who)
        name = who if len(who) <= 32 else "…" + who[-31:]
        lines.append(
            f"{name:<32} {r.actors:>3} {f'{r.uncertainty:.4f}{spread}':>18} {times:>8} {r.collisions:>11.1f} "
            f"{r.blocked:>8.1f} {r.seconds:>8.1f}"
        )
    return "\n".join(lines)
