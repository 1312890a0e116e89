"""Measures how far UAVs run ahead of one that is delayed, and what bounds them; and checks that the flight is the same.

The map is a wide plain with streets only in its corners, so the distances between UAVs are known.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, sqrt
from pathlib import Path
from typing import Any

from deploy.run.mission import check
from deploy.verify import exactness
from tmc.kernel.config import Config, ConfigError, build
from tmc.kernel.grid import Grid
from tmc.kernel.world import World
from tmc.record import compare
from tmc.record.overfly_pb2 import UavStatus
from tmc.record.reader import Log
from tmc.record.run_folder import run_files

SIDE_CELLS = 120
"""Width of the plain."""
CORNER_CELLS = 3
"""Width of the corner in which the delayed UAV is alone."""
NO_EXCHANGE_TICKS = 1000
"""A T_u beyond the end of every flight here."""
MAX_SEEDS = 10_000
"""Seeds to try for the starts that a flight needs."""


@dataclass(frozen=True)
class Trial:
    """A flight. `apart`: the delayed UAV starts alone in the corner opposite the others; otherwise among them."""

    about: str
    apart: bool
    period: int
    ticks: int


TRIALS: tuple[Trial, ...] = (
    Trial("opposite corners, no exchange", apart=True, period=NO_EXCHANGE_TICKS, ticks=160),
    Trial("opposite corners, T_u = 20", apart=True, period=20, ticks=80),
    Trial("opposite corners, a short episode", apart=True, period=NO_EXCHANGE_TICKS, ticks=60),
    Trial("all in one corner, no exchange", apart=False, period=NO_EXCHANGE_TICKS, ticks=100),
    Trial("all in one corner, T_u = 20", apart=False, period=20, ticks=80),
)


@dataclass(frozen=True)
class LargestLead:
    """The largest lead over the delayed UAV: in ticks, of UAV `uav`, at its tick `at_tick`.

    `bound`: what it waited for: "distance" (the look-ahead rule), "exchange" or "end". `cells`: its distance to the
    delayed UAV. `allowed`: the rules of the model allow such a lead.
    """

    ticks: int
    uav: int
    at_tick: int
    bound: str
    cells: int
    allowed: bool


@dataclass(frozen=True)
class Result:
    """The result of a trial. `difference`: the first fact that is not as in lock step; None without one."""

    trial: Trial
    delayed_uav: int
    lead: LargestLead
    seconds: float
    difference: compare.Difference | None

    @property
    def passed(self) -> bool:
        """Whether the flight is as in lock step, the lead is allowed, and large enough where one is expected."""
        expected = min(self.trial.period, self.trial.ticks, SIDE_CELLS // 2) // 2 if self.trial.apart else 0
        return self.difference is None and self.lead.allowed and self.lead.ticks >= expected

    @property
    def result(self) -> str:
        """The result in words."""
        if self.difference is not None:
            return f"DIFFERENT: {self.difference}"
        if not self.lead.allowed:
            return "TOO FAR AHEAD"
        return "as in lock step" if self.passed else "NOT FAR AHEAD"

    def row(self) -> str:
        """Return a line of the table."""
        lead = self.lead
        return (
            f"{self.trial.about:<34} {self.trial.ticks:>5} {lead.ticks:>5} {lead.uav:>4} {self.delayed_uav:>5} "
            f"{lead.at_tick:>7} {lead.cells:>6}  {lead.bound:<9} {self.seconds:>7.1f}  {self.result}"
        )


HEAD = (
    f"{'flight':<34} {'ticks':>5} {'lead':>5} {'of':>4} {'over':>5} {'at tick':>7} {'cells':>6}  {'bound by':<9} "
    f"{'seconds':>7}  flown"
)


def raster(team: int, *, apart: bool) -> str:
    """Return the plain as text, with streets for the team in one corner, or in two opposite ones if `apart`.

    Raises ConfigError if the team does not fit.
    """
    near, far = (CORNER_CELLS if apart else 0), ceil(sqrt(3 * team)) + 1
    if near + far > SIDE_CELLS:
        raise ConfigError(f"{team} UAVs do not fit into a corner of {SIDE_CELLS} x {SIDE_CELLS} cells: choose fewer")
    rows = []
    for row in range(SIDE_CELLS):
        first = near if row < near else 0
        last = far if row >= SIDE_CELLS - far else 0
        rows.append("#" * first + "." * (SIDE_CELLS - first - last) + "#" * last)
    return "\n".join([f"name: corners of {SIDE_CELLS} cells", *rows, ""])


def config_of(trial: Trial, team: int, hold: float, base: Mapping[str, Any], road_map: Path) -> tuple[Config, int]:
    """Return (mission of a trial, delayed UAV); the delayed UAV is the one that starts alone, if there is one.

    `hold`: delay in s per tick. Raises ConfigError.
    """
    values = {
        **base, "scenario": 2, "world.map": str(road_map), "world.start": "road", "team.size": team,
        "comms.period": trial.period, "training.ticks": trial.ticks, "trial.stall": hold,
    }  # fmt: skip
    world = World(build(values))
    for seed in range(1, MAX_SEEDS):
        config = build({"training.seed": seed}, world.config)
        starts = World(config, world.map).starts(1)
        alone = [i for i, cell in enumerate(starts) if cell < SIDE_CELLS * CORNER_CELLS]
        if not trial.apart or len(alone) == 1:
            delayed_uav = alone[0] if trial.apart else 0
            return build({"trial.stall_uav": delayed_uav}, config), delayed_uav
    raise ConfigError(f"no starts of {team} UAVs with one of them alone in its corner were found: choose fewer")


def fly(trial: Trial, team: int, hold: float, base: Mapping[str, Any], policy: bytes | None, folder: Path) -> Result:
    """Fly a trial in `folder`, which is removed when the trial passes. `hold`: delay in s per tick.

    Raises exactness.MissionAborted, ConfigError.
    """
    start = time.perf_counter()
    folder.mkdir(parents=True)
    road_map = folder.absolute() / "corners.txt"
    try:
        road_map.write_text(raster(team, apart=trial.apart), "utf-8")
        config, delayed_uav = config_of(trial, team, hold, base, road_map)
        check(config, policy)
    except BaseException:  # nothing was flown, so nothing is kept
        shutil.rmtree(folder)
        raise
    facts, reference = exactness.fly_both(config, policy, folder)
    difference = compare.first_difference(facts, reference)
    lead = farthest(config, facts, folder / exactness.PROCESSES, delayed_uav)
    result = Result(trial, delayed_uav, lead, time.perf_counter() - start, difference)
    if result.passed:
        shutil.rmtree(folder)
    return result


def farthest(config: Config, facts: compare.Facts, flight: Path, delayed_uav: int) -> LargestLead:
    """Return the largest lead over the delayed UAV, by the logs of the UAVs."""
    found = []
    for uav in set(range(config.team.size)) - {delayed_uav}:
        *_, last = Log(run_files(flight)[f"uav-{uav:03d}"]).messages(UavStatus)
        found.append((last.lead_most, uav, last.lead_tick, last.lead_bound))
    lead, uav, at, bound = max(found)
    chebyshev = Grid(SIDE_CELLS, SIDE_CELLS).chebyshev
    there = compare.cell(facts, 1, at - lead, delayed_uav)
    cells, before = (chebyshev(compare.cell(facts, 1, t, uav), there) for t in (at, max(at - 1, 0)))
    # It sensed its peers at the tick before without this one: allowed only from farther than the moves of both.
    allowed = lead <= config.T_u and (lead <= 1 or before > lead)
    return LargestLead(lead, uav, at, bound, cells, allowed)
