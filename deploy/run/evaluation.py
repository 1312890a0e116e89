"""Compares policies and planners: many missions of one episode each, in lock step, and a table of their means."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean, stdev
from typing import Any

from deploy import policy_spec
from deploy.run import lockstep, pool
from deploy.run.mission import bound_of, check
from tmc.center.roster import Outbox
from tmc.kernel.config import Config, ConfigError, build
from tmc.kernel.policy import FlightError
from tmc.kernel.roadmap import builtin_maps, load_map
from tmc.kernel.text import printable
from tmc.kernel.world import World

FIRST_SEED = 1_000_000
"""Seeds of an evaluation start here, far from those that people train with."""
WORLD = ("scenario", "team.size", "team.sensing_range", "comms.period", "comms.phase", "training.ticks")
"""What a run brings along for all that it is compared with, beside `world.*`."""
T_975 = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131,
    2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip
"""97.5 % points of Student's t for 1 to 30 degrees of freedom."""


@dataclass(frozen=True)
class MissionResult:
    """One mission of `who` with N = `actors` UAVs.

    `uncertainty`: eq. (6), the mean per monitored cell; `bound`: the lower bound of it, 0 where unknown. `collisions`:
    moves blocked by another UAV; `blocked`: by any cause. `seconds`: wall time.
    """

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
    """A line of the table: means over `seeds` missions of `who` with `actors` UAVs; `seconds` is their sum.

    `uncertainty`: mean per monitored cell, eq. (6); `interval`: half the width of its 95 % interval, NaN for one seed;
    `times_bound`: its ratio to the lower bound, NaN where that is unknown. `collisions`: moves blocked by another UAV,
    `blocked`: by any cause, per mission.
    """

    who: str
    actors: int
    seeds: int
    uncertainty: float
    interval: float
    times_bound: float
    collisions: float
    blocked: float
    seconds: float


@dataclass(frozen=True)
class Table:
    """The outcome of an evaluation. `str(table)` is what `overfly evaluate` prints.

    `rows`: one for each `who` and team size, in the order given. `missions`: one for each seed as well. `config`: the
    settings of the first mission.
    """

    rows: tuple[Row, ...]
    missions: tuple[MissionResult, ...]
    config: Config

    def __str__(self) -> str:
        return text(self.rows, self.config)


Say = Callable[[str], None]
"""Takes a line for the user."""


def evaluate(
    whos: Iterable[str], chosen: Mapping[str, Any], teams: Sequence[int], seeds: range, jobs: int, say: Say, show: Say
) -> Table:
    """Fly every mission on `jobs` processes.

    `chosen`: settings by dotted key, for all of them. `teams`: team sizes; empty for the size that the settings have.
    `say` takes a sentence on settings of a run that were edited since, `show` a line of progress now and then.
    Raises ConfigError, PolicyError or MapError before the first mission; FlightError, FailedError.
    """
    work = list(missions(whos, chosen, teams, seeds, say))
    flown = tuple(fly_all(work, jobs, show))
    return Table(tuple(table(flown)), flown, work[0][1])


def missions(
    whos: Iterable[str], chosen: Mapping[str, Any], teams: Sequence[int], seeds: range, say: Say
) -> Iterator[tuple[str, Config, bytes | None]]:
    """Yield (name, config, policy) of every mission, checked before the first one flies."""
    sizes: list[int | None] = [*teams] or [None]
    pilots = [policy_spec.resolve(name, say) for name in dict.fromkeys(whos)]
    shared = shared_world(pilots, {*chosen, *(["team.size"] if teams else [])})
    for pilot in pilots:
        for n in sizes:
            size = {} if n is None else {"team.size": n}
            config = build(policy_spec.mission_values(pilot, shared, chosen, size))
            check(config, pilot.policy, pilot.name)
            for seed in seeds:
                yield pilot.name, build({"training.seed": seed}, config), pilot.policy


def shared_world(pilots: list[policy_spec.PolicySpec], chosen: Collection[str] = ()) -> dict[str, Any]:
    """Return the world of the run folders among `pilots`, for all rows of the table.

    Raises ConfigError if they do not agree on what is not `chosen` for all of them.
    """
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


def fly_one(mission: tuple[str, Config, bytes | None]) -> MissionResult:
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
    return MissionResult(
        name, config.team.size, config.training.seed, station.episode_uncertainty / cells, bound_of(world) / cells,
        station.blocked_by_uav, station.blocked, seconds,
    )  # fmt: skip


def _forget(_outbox: Outbox) -> None:
    """An evaluation keeps no journal."""


def fly_all(work: list[tuple[str, Config, bytes | None]], jobs: int, show: Say) -> Iterator[MissionResult]:
    """Fly all missions on `jobs` processes, in this one where that is enough, with progress."""
    flights = map(fly_one, work) if jobs == 1 or len(work) == 1 else pool.call_each(fly_one, work, jobs)
    return _progress(flights, len(work), show)


def _progress(flights: Iterable[MissionResult], total: int, show: Say) -> Iterator[MissionResult]:
    start, said = time.monotonic(), time.monotonic()
    for done, flight in enumerate(flights, 1):
        now = time.monotonic()
        if now - said > 2 and done < total:
            left = (now - start) / done * (total - done)
            show(f"{done}/{total} missions · {done / (now - start):.1f}/s · {left:.0f} s left")
            said = now
        yield flight


def table(flights: Iterable[MissionResult]) -> list[Row]:
    """Return one row for each policy or planner and N, in the order flown."""
    groups: dict[tuple[str, int], list[MissionResult]] = {}
    for flight in flights:
        groups.setdefault((flight.who, flight.actors), []).append(flight)
    return [_row(who, n, group) for (who, n), group in groups.items()]


def _row(name: str, n: int, group: list[MissionResult]) -> Row:
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


def text(rows: Sequence[Row], config: Config) -> str:
    """The table for a person."""
    scenario, ticks = config.scenario, config.training.ticks
    lines = [
        f"Mean uncertainty per road cell: {ticks:,} ticks, scenario {scenario}, T_u = {config.T_u}, "
        f"{printable(config.world.map)};",
        f"mean of {rows[0].seeds} seeds with its 95 % interval. x bound: against a lower bound that no team can beat.",
        "blocked: moves refused in a mission; collisions: those of them that another UAV stood in the way of.",
        "",
        f"{'policy':<32} {'N':>3} {'uncertainty':>18} {'x bound':>8} {'collisions':>11} {'blocked':>8} {'seconds':>8}",
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
