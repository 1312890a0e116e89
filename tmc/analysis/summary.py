"""The metrics of a run: one frozen `Summary`.

Uncertainties are eq. (6): of the true map, summed over cells, averaged over ticks 1..T; in scenario I, the number of
active events. A tick is 60 s of simulated time. A value that the run does not have is None.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Mission:
    """The mission. `controller`: planner, fixed policy, or the policy in training; `T_u`, `ticks`: ticks."""

    command: str
    controller: str
    learning: bool
    scenario: int
    uavs: int
    T_u: int
    map: str
    roads: str
    obstacles: str
    road_cells: int
    monitored_cells: int
    cell_m: float
    seed: int
    ticks: int
    episodes_planned: int
    episodes_flown: int


@dataclass(frozen=True)
class EpisodeFacts:
    """The metrics of one episode.

    `uncertainty`: summed over cells; `per_cell`: per monitored cell; `times_bound`: relative to the lower bound.
    `reward`: mean per UAV per tick. `moves`, `blocked_*`: of all UAVs.
    `on_road`: share of the UAVs' ticks over road, 0 to 1; `coverage`: share of the road cells visited, 0 to 1.
    `events_*`, `mean_wait` (ticks until cleared): scenario I only.
    """

    episode: int
    ticks: int
    complete: bool
    uncertainty: float
    per_cell: float
    times_bound: float | None
    reward: float
    moves: int
    blocked_grid: int
    blocked_obstacle: int
    blocked_uav: int
    on_road: float
    coverage: float
    events_appeared: int | None
    events_cleared: int | None
    mean_wait: float | None
    epsilon: float | None
    updates: int | None

    @property
    def blocked(self) -> int:
        """The number of blocked moves, all causes."""
        return self.blocked_grid + self.blocked_obstacle + self.blocked_uav


@dataclass(frozen=True)
class Mean:
    """Means over the last `episodes` episodes: in training the last tenth, otherwise all."""

    episodes: int
    uncertainty: float
    per_cell: float
    times_bound: float | None
    reward: float


@dataclass(frozen=True)
class Pace:
    """How fast the run was. `seconds`: working time of the processes, by a monotonic clock.

    `ticks`: of the team. `updates`: of the network. `loss`, `q_mean`: the last ones logged.
    """

    seconds: float
    ticks: int
    ticks_per_second: float
    updates: int
    updates_per_second: float
    loss: float | None
    q_mean: float | None


@dataclass(frozen=True)
class Health:
    """Exit codes and restarts by process, from run.json; size of the logs, bytes; what is wrong with the logs."""

    exit_codes: dict[str, int | None]
    restarts: dict[str, int]
    log_files: tuple[str, ...]
    log_bytes: int
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Summary:
    """The metrics of a run. `first`, `last`, `best`: complete episodes, if any. An unknown bound is None."""

    run: str
    mission: Mission
    lower_bound: float | None
    lower_bound_per_cell: float | None
    first: EpisodeFacts
    last: EpisodeFacts
    best: EpisodeFacts
    mean: Mean
    moves: int
    blocked_grid: int
    blocked_obstacle: int
    blocked_uav: int
    blocked_share: float
    pace: Pace
    health: Health
    episodes: tuple[EpisodeFacts, ...]

    @property
    def blocked(self) -> int:
        """The number of blocked moves in the run, all causes."""
        return self.blocked_grid + self.blocked_obstacle + self.blocked_uav

    def to_json(self) -> str:
        """Return the summary as JSON."""
        return json.dumps(asdict(self), indent=1, allow_nan=False)
