"""What a run comes to, in numbers: one frozen `Summary`, from the log alone.

Uncertainties are eq. (6): the sum over cells of the true map's uncertainty, averaged over ticks 1..T (scenario I: the
number of active events). A tick is a minute of simulated time. None stands for what the run does not have.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Mission:
    """What was to be flown. `who`: planner, fixed policy, or the policy in training; `T_u`, `ticks`: ticks."""

    command: str
    who: str
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
    """One episode. `uncertainty`: sum over cells; `per_cell`: by monitored cell; `times_bound`: over the lower bound.

    `reward`: a UAV a tick. `moves`, `blocked_*`: of all UAVs. `on_road`: share of the UAVs' ticks over road;
    `coverage`: share of the road cells visited. `events_*`, `mean_wait` (ticks until cleared): scenario I only.
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
        """Blocked moves of all causes."""
        return self.blocked_grid + self.blocked_obstacle + self.blocked_uav


@dataclass(frozen=True)
class Mean:
    """Mean over the last `episodes` episodes: in training the last tenth, otherwise all."""

    episodes: int
    uncertainty: float
    per_cell: float
    times_bound: float | None
    reward: float


@dataclass(frozen=True)
class Pace:
    """`seconds`: how long the processes were at work, by a clock that is never set.

    `ticks` of the team, `updates` of the network.
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
    """Exit codes and restarts by process, from run.json; the size of the logs, and what is wrong with them."""

    exit_codes: dict[str, int | None]
    restarts: dict[str, int]
    log_files: tuple[str, ...]
    log_bytes: int
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Summary:
    """A run. `first`, `last`, `best` are complete episodes (where there is one); the bound is None where unknown."""

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
        """Blocked moves of all causes, in the whole run."""
        return self.blocked_grid + self.blocked_obstacle + self.blocked_uav

    def to_json(self) -> str:
        """All of it as JSON."""
        return json.dumps(asdict(self), indent=1, allow_nan=False)
