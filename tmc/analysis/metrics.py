"""The numbers of a run, from its log alone; `tmc.analysis.summary` says what each of them is."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmc.analysis.run_data import UNKNOWN, Episode, Learning, RunData, read
from tmc.analysis.summary import EpisodeFacts, Health, Mean, Mission, Pace, Summary
from tmc.kernel.reward import Block
from tmc.kernel.uncertainty import lower_bound
from tmc.kernel.world import World

TAIL = 0.1
"""Share of a training run's episodes, the last ones, whose mean says how well it flies in the end."""

FIXED_POLICY = "policies/flown.onnx"
"""In a run folder: the policy of a mission that learns nothing."""


def summary(folder: Path) -> Summary:
    """The summary of a run folder; RecordError when it is none, or when nothing was flown in it."""
    return summarize(read(folder))


def summarize(flown: RunData) -> Summary:
    """The summary of what was read."""
    world, cells = flown.world, flown.world.law.cells.size
    facts = tuple(episode_facts(world, episode) for episode in flown.episodes)
    whole = [f for f in facts if f.complete] or list(facts)
    mission = _mission(flown, len(whole) if whole[0].complete else 0)
    bound = bound_of(world, whole[-1].ticks)
    moves, blocked = sum(f.moves for f in facts), sum(f.blocked for f in facts)
    return Summary(
        run=str(flown.folder),
        mission=mission,
        lower_bound=bound,
        lower_bound_per_cell=None if bound is None else bound / cells,
        first=whole[0],
        last=whole[-1],
        best=min(whole, key=lambda f: f.uncertainty),
        mean=_mean(whole[-max(1, round(TAIL * len(whole))) :] if mission.learning else whole),
        moves=moves,
        blocked_grid=sum(f.blocked_grid for f in facts),
        blocked_obstacle=sum(f.blocked_obstacle for f in facts),
        blocked_uav=sum(f.blocked_uav for f in facts),
        blocked_share=blocked / moves if moves else 0.0,
        pace=_pace(flown, facts),
        health=_health(flown),
        episodes=facts,
    )


def bound_of(world: World, ticks: int) -> float | None:
    """What no team can beat in so many ticks (sum over cells): known in scenario II from a visited map only."""
    config = world.config
    if config.scenario != 2 or config.world.initial_map != "visited":
        return None
    return _bound(world.alpha.tobytes(), config.team.size, ticks) or None


@cache
def _bound(alpha: bytes, uavs: int, ticks: int) -> float:
    return lower_bound(np.frombuffer(alpha), uavs, ticks)


def episode_facts(world: World, episode: Episode) -> EpisodeFacts:
    """The numbers of one episode, of the ticks that the log holds."""
    mean = _of_known(episode.uncertainty[1:])
    bound, (appeared, cleared, wait) = bound_of(world, episode.ticks), event_facts(world, episode)
    flown, blocks = episode.cells[1:][episode.cells[1:] != UNKNOWN], episode.blocks
    visited = np.unique(episode.cells[episode.cells != UNKNOWN])
    return EpisodeFacts(
        episode=episode.number,
        ticks=episode.ticks,
        complete=episode.complete,
        uncertainty=mean,
        per_cell=mean / world.law.cells.size,
        times_bound=None if bound is None else mean / bound,
        reward=_of_known(episode.reward[1:]),
        moves=sum(blocks.values()),
        blocked_grid=blocks.get(Block.GRID, 0),
        blocked_obstacle=blocks.get(Block.OBSTACLE, 0),
        blocked_uav=blocks.get(Block.UAV, 0),
        on_road=_of_known(world.map.road[flown]),
        coverage=float(world.map.road[visited].sum() / world.map.road.sum()),
        events_appeared=appeared,
        events_cleared=cleared,
        mean_wait=wait,
        epsilon=episode.epsilon,
        updates=episode.updates,
    )


def _of_known(values: NDArray[Any]) -> float:
    """The mean of what is known; 0.0 where nothing is, as in an episode whose UAVs were all lost at its start."""
    known = values[~np.isnan(values)] if values.dtype.kind == "f" else values
    return float(known.mean()) if known.size else 0.0


def event_facts(world: World, episode: Episode) -> tuple[int | None, int | None, float | None]:
    """Events that appeared, those that were cleared, and the mean ticks that these waited; None in scenario II."""
    if world.config.scenario != 1:
        return None, None, None
    waits = event_waits(episode.cells, episode.events)
    done = waits[waits > 0]
    return waits.size, done.size, float(done.mean()) if done.size else None


def event_waits(cells: NDArray[np.int64], events: NDArray[np.int64]) -> NDArray[np.int64]:
    """Shape (E,): ticks from each event (tick, cell) to the next visit of its cell, 0 where none came.

    An event of tick t is there after the visits of that tick, so a UAV that stands on it clears it at t + 1.
    """
    visits: dict[int, list[int]] = {}
    wanted = set(events[:, 1].tolist())
    for tick, row in enumerate(cells.tolist()):
        for cell in wanted.intersection(row):
            visits.setdefault(cell, []).append(tick)
    return np.array([_wait(tick, visits.get(cell, [])) for tick, cell in events.tolist()], np.int64)


def _wait(tick: int, visits: list[int]) -> int:
    place = bisect_right(visits, tick)
    return visits[place] - tick if place < len(visits) else 0


def _mission(flown: RunData, episodes: int) -> Mission:
    world, config = flown.world, flown.world.config
    learning = is_learning(flown)
    fixed = "a fixed policy" if config.team.controller == "policy" else config.team.controller
    return Mission(
        command=str(flown.outcome.get("command", "")),
        who="a policy in training" if learning else fixed,
        learning=learning,
        scenario=config.scenario,
        uavs=config.team.size,
        T_u=config.T_u,
        map=world.map.name,
        roads=config.world.roads,
        obstacles=config.world.obstacles,
        road_cells=int(world.map.road.sum()),
        monitored_cells=int(world.law.cells.size),
        cell_m=world.map.cell_m,
        seed=config.training.seed,
        ticks=config.training.ticks,
        episodes_planned=config.training.episodes,
        episodes_flown=episodes,
    )


def is_learning(flown: RunData) -> bool:
    """True when a learner took part: a policy flew, and not one that was fixed from the start."""
    learned = "learner" in flown.files or flown.updates > 0
    return flown.world.config.team.controller == "policy" and (learned or not (flown.folder / FIXED_POLICY).exists())


def _mean(facts: Iterable[EpisodeFacts]) -> Mean:
    rows = list(facts)
    bounds = [f.times_bound for f in rows if f.times_bound is not None]
    return Mean(
        episodes=len(rows),
        uncertainty=float(np.mean([f.uncertainty for f in rows])),
        per_cell=float(np.mean([f.per_cell for f in rows])),
        times_bound=float(np.mean(bounds)) if bounds else None,
        reward=float(np.mean([f.reward for f in rows])),
    )


def _pace(flown: RunData, facts: Iterable[EpisodeFacts]) -> Pace:
    ticks, learning = sum(f.ticks for f in facts), flown.learning
    updates, seconds = flown.updates, flown.seconds
    rate = 1.0 / seconds if seconds > 0 else 0.0
    loss, q_mean = _last(learning, "loss"), _last(learning, "q_mean")
    return Pace(round(seconds, 3), ticks, ticks * rate, updates, updates * rate, loss, q_mean)


def _last(learning: Learning, name: str) -> float | None:
    values: NDArray[np.float64] = getattr(learning, name)
    return float(values[-1]) if values.size and np.isfinite(values[-1]) else None


def _health(flown: RunData) -> Health:
    def table(name: str) -> dict[str, Any]:
        found = flown.outcome.get(name)
        return dict(found) if isinstance(found, Mapping) else {}

    paths = flown.files.values()
    return Health(
        exit_codes=table("exit_codes"),
        restarts=table("restarts"),
        log_files=tuple(p.name for p in paths),
        log_bytes=sum(p.stat().st_size for p in paths),
        notes=flown.notes,
    )
