"""How far UAVs run ahead of one that is held back, what bounds them, and that they fly the same all the same.

The map is a wide plain with streets in its corners only, so it is known who is far from whom.
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
from tmc.record.channels import uav_topic
from tmc.record.reader import read
from tmc.record.run_folder import run_files

SIDE = 120
"""Width of the plain, in cells."""
CORNER = 3
"""Width of the corner in which the UAV is alone that is held back."""
NEVER = 1000
"""A T_u beyond the end of every flight here."""
SEEDS = 10_000
"""Seeds that are tried for the starts that a flight needs."""


@dataclass(frozen=True)
class Trial:
    """A flight: does the one that is held back stand alone in the corner opposite the others, or among them?"""

    about: str
    apart: bool
    period: int
    ticks: int


TRIALS: tuple[Trial, ...] = (
    Trial("opposite corners, no exchange", apart=True, period=NEVER, ticks=160),
    Trial("opposite corners, T_u = 20", apart=True, period=20, ticks=80),
    Trial("opposite corners, a short episode", apart=True, period=NEVER, ticks=60),
    Trial("all in one corner, no exchange", apart=False, period=NEVER, ticks=100),
    Trial("all in one corner, T_u = 20", apart=False, period=20, ticks=80),
)


@dataclass(frozen=True)
class Ahead:
    """The largest lead over the UAV that was held back: how many ticks, whose, and at which of its ticks.

    `bound`: what it waited for: distance (the look-ahead rule), exchange or end. `cells`: how far away the one held
    back was. `right`: no rule of the model forbids it.
    """

    ticks: int
    uav: int
    at: int
    bound: str
    cells: int
    right: bool


@dataclass(frozen=True)
class Result:
    """What came of a trial: who was held back, who ran ahead of it, and whether all flew as in lock step."""

    trial: Trial
    held_back: int
    ahead: Ahead
    seconds: float
    difference: compare.Difference | None

    @property
    def good(self) -> bool:
        """RunData as in lock step, nobody ahead wrongly; and, where a lead was to be expected, there was one."""
        expected = min(self.trial.period, self.trial.ticks, SIDE // 2) // 2 if self.trial.apart else 0
        return self.difference is None and self.ahead.right and self.ahead.ticks >= expected

    @property
    def result(self) -> str:
        """In words."""
        if self.difference is not None:
            return f"DIFFERENT: {self.difference}"
        if not self.ahead.right:
            return "RAN AHEAD WRONGLY"
        return "as in lock step" if self.good else "HARDLY RAN AHEAD"

    def row(self) -> str:
        """A line of the table."""
        ahead = self.ahead
        return (
            f"{self.trial.about:<34} {self.trial.ticks:>5} {ahead.ticks:>5} {ahead.uav:>4} {self.held_back:>5} "
            f"{ahead.at:>7} {ahead.cells:>6}  {ahead.bound:<9} {self.seconds:>7.1f}  {self.result}"
        )


HEAD = (
    f"{'flight':<34} {'ticks':>5} {'lead':>5} {'of':>4} {'over':>5} {'at tick':>7} {'cells':>6}  {'bound by':<9} "
    f"{'seconds':>7}  flown"
)


def raster(team: int, *, apart: bool) -> str:
    """The plain as text, with as many streets in the corners as the team needs: one corner, or two opposite ones."""
    near, far = (CORNER if apart else 0), ceil(sqrt(3 * team)) + 1
    if near + far > SIDE:
        raise ConfigError(f"{team} UAVs do not fit into a corner of {SIDE} x {SIDE} cells: choose fewer")
    rows = []
    for row in range(SIDE):
        first = near if row < near else 0
        last = far if row >= SIDE - far else 0
        rows.append("#" * first + "." * (SIDE - first - last) + "#" * last)
    return "\n".join([f"name: corners of {SIDE} cells", *rows, ""])


def config_of(trial: Trial, team: int, hold: float, base: Mapping[str, Any], road_map: Path) -> tuple[Config, int]:
    """The mission of a trial, and the UAV that is held back: the one that is alone, where there is one."""
    values = {
        **base, "scenario": 2, "world.map": str(road_map), "world.start": "road", "team.size": team,
        "comms.period": trial.period, "training.ticks": trial.ticks, "trial.stall": hold,
    }  # fmt: skip
    world = World(build(values))
    for seed in range(1, SEEDS):
        config = build({"training.seed": seed}, world.config)
        starts = World(config, world.map).starts(1)
        alone = [i for i, cell in enumerate(starts) if cell < SIDE * CORNER]
        if not trial.apart or len(alone) == 1:
            held_back = alone[0] if trial.apart else 0
            return build({"trial.stall_uav": held_back}, config), held_back
    raise ConfigError(f"no starts of {team} UAVs with one of them alone in its corner were found: choose fewer")


def fly(trial: Trial, team: int, hold: float, base: Mapping[str, Any], policy: bytes | None, folder: Path) -> Result:
    """Fly a trial in `folder`, which is removed when all was well; `hold`: seconds a tick. Raises exactness.Stopped."""
    start = time.perf_counter()
    folder.mkdir(parents=True)
    road_map = folder.absolute() / "corners.txt"
    try:
        road_map.write_text(raster(team, apart=trial.apart), "utf-8")
        config, held_back = config_of(trial, team, hold, base, road_map)
        check(config, policy)
    except BaseException:  # nothing was flown: nothing is left
        shutil.rmtree(folder)
        raise
    facts, reference = exactness.fly_both(config, policy, folder)
    difference = compare.first_difference(facts, reference)
    ahead = farthest(config, facts, folder / exactness.PROCESSES, held_back)
    result = Result(trial, held_back, ahead, time.perf_counter() - start, difference)
    if result.good:
        shutil.rmtree(folder)
    return result


def farthest(config: Config, facts: compare.Facts, flight: Path, held_back: int) -> Ahead:
    """PolicySpec was farthest ahead, by the logs of the UAVs, and where the two were then."""
    found = []
    for uav in set(range(config.team.size)) - {held_back}:
        *_, last = read(run_files(flight)[f"uav-{uav:03d}"], [uav_topic(uav, "status")])
        found.append((last.message.lead_most, uav, last.message.lead_tick, last.message.lead_bound))
    lead, uav, at, bound = max(found)
    chebyshev = Grid(SIDE, SIDE).chebyshev
    there = compare.cell(facts, 1, at - lead, held_back)
    cells, before = (chebyshev(compare.cell(facts, 1, t, uav), there) for t in (at, max(at - 1, 0)))
    # It sensed its peers at the tick before, without this one: that was right only from farther than the sum of moves.
    right = lead <= config.T_u and (lead <= 1 or before > lead)
    return Ahead(lead, uav, at, bound, cells, right)
