"""Compute the metrics of a run from its logs; `tmc.analysis.summary` defines each of them."""

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
from tmc.record.run_folder import RunFolder

LAST_EPISODES_SHARE = 0.1
"""Share of a training's episodes, the last ones, whose mean is its result."""


def summary(folder: Path) -> Summary:
    """Return the summary of a run folder; RecordError when it is not one, or holds no flight."""
    return summarize(read(folder))


def summarize(run: RunData) -> Summary:
    """Return the summary of a run."""
    world, cells = run.world, run.world.law.cells.size
    facts = tuple(episode_facts(world, episode) for episode in run.episodes)
    whole = [f for f in facts if f.complete] or list(facts)
    mission = _mission(run, len(whole) if whole[0].complete else 0)
    bound = bound_of(world, whole[-1].ticks)
    moves, blocked = sum(f.moves for f in facts), sum(f.blocked for f in facts)
    return Summary(
        run=str(run.folder),
        mission=mission,
        lower_bound=bound,
        lower_bound_per_cell=None if bound is None else bound / cells,
        first=whole[0],
        last=whole[-1],
        best=min(whole, key=lambda f: f.uncertainty),
        mean=_mean(whole[-max(1, round(LAST_EPISODES_SHARE * len(whole))) :] if mission.learning else whole),
        moves=moves,
        blocked_grid=sum(f.blocked_grid for f in facts),
        blocked_obstacle=sum(f.blocked_obstacle for f in facts),
        blocked_uav=sum(f.blocked_uav for f in facts),
        blocked_share=blocked / moves if moves else 0.0,
        pace=_pace(run, facts),
        health=_health(run),
        episodes=facts,
    )


def bound_of(world: World, ticks: int) -> float | None:
    """Return a lower bound of the uncertainty of an episode (sum over cells), which no team can beat.

    None where none is known: in scenario I, and where the map does not start visited.
    """
    config = world.config
    if config.scenario != 2 or config.world.initial_map != "visited":
        return None
    return _bound(world.alpha.tobytes(), config.team.size, ticks) or None


@cache
def _bound(alpha: bytes, uavs: int, ticks: int) -> float:
    return lower_bound(np.frombuffer(alpha), uavs, ticks)


def episode_facts(world: World, episode: Episode) -> EpisodeFacts:
    """Return the metrics of one episode, over the ticks that the log holds."""
    mean = _known_mean(episode.uncertainty[1:])
    bound, (appeared, cleared, wait) = bound_of(world, episode.ticks), event_facts(world, episode)
    cells, blocks = episode.cells[1:][episode.cells[1:] != UNKNOWN], episode.blocks
    visited = np.unique(episode.cells[episode.cells != UNKNOWN])
    return EpisodeFacts(
        episode=episode.number,
        ticks=episode.ticks,
        complete=episode.complete,
        uncertainty=mean,
        per_cell=mean / world.law.cells.size,
        times_bound=None if bound is None else mean / bound,
        reward=_known_mean(episode.reward[1:]),
        moves=sum(blocks.values()),
        blocked_grid=blocks.get(Block.GRID, 0),
        blocked_obstacle=blocks.get(Block.OBSTACLE, 0),
        blocked_uav=blocks.get(Block.UAV, 0),
        on_road=_known_mean(world.map.road[cells]),
        coverage=float(world.map.road[visited].sum() / world.map.road.sum()),
        events_appeared=appeared,
        events_cleared=cleared,
        mean_wait=wait,
        epsilon=episode.epsilon,
        updates=episode.updates,
    )


def _known_mean(values: NDArray[Any]) -> float:
    """Return the mean without NaN; 0.0 without any value, as in an episode whose UAVs were all lost at its start."""
    known = values[~np.isnan(values)] if values.dtype.kind == "f" else values
    return float(known.mean()) if known.size else 0.0


def event_facts(world: World, episode: Episode) -> tuple[int | None, int | None, float | None]:
    """Return the events that appeared, those that were cleared, and their mean wait, ticks; None in scenario II."""
    if world.config.scenario != 1:
        return None, None, None
    waits = event_waits(episode.cells, episode.events)
    done = waits[waits > 0]
    return waits.size, done.size, float(done.mean()) if done.size else None


def event_waits(cells: NDArray[np.int64], events: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the ticks from each event (tick, cell) to the next visit of its cell; 0 without one. Shape (E,), int64.

    An event of tick t appears after the visits of that tick, so a UAV on its cell clears it at t + 1.
    """
    visits: dict[int, list[int]] = {}
    wanted = set(events[:, 1].tolist())
    for tick, row in enumerate(cells.tolist()):
        for cell in wanted.intersection(row):
            visits.setdefault(cell, []).append(tick)
    return np.array([_wait(tick, visits.get(cell, [])) for tick, cell in events.tolist()], np.int64)


def _wait(tick: int, visits: list[int]) -> int:
    index = bisect_right(visits, tick)
    return visits[index] - tick if index < len(visits) else 0


def _mission(run: RunData, episodes: int) -> Mission:
    world, config = run.world, run.world.config
    learning = is_learning(run)
    fixed = "a fixed policy" if config.team.controller == "policy" else config.team.controller
    return Mission(
        command=str(run.outcome.get("command", "")),
        controller="a policy in training" if learning else fixed,
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


def is_learning(run: RunData) -> bool:
    """True when a learner took part: a policy flew, and it was not fixed from the start."""
    learned = "learner" in run.files or run.updates > 0
    return run.world.config.team.controller == "policy" and (learned or not RunFolder(run.folder).fixed_policy.exists())


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


def _pace(run: RunData, facts: Iterable[EpisodeFacts]) -> Pace:
    ticks, learning = sum(f.ticks for f in facts), run.learning
    updates, seconds = run.updates, run.seconds
    rate = 1.0 / seconds if seconds > 0 else 0.0
    loss, q_mean = _last(learning, "loss"), _last(learning, "q_mean")
    return Pace(round(seconds, 3), ticks, ticks * rate, updates, updates * rate, loss, q_mean)


def _last(learning: Learning, name: str) -> float | None:
    values: NDArray[np.float64] = getattr(learning, name)
    return float(values[-1]) if values.size and np.isfinite(values[-1]) else None


def _health(run: RunData) -> Health:
    def table(name: str) -> dict[str, Any]:
        found = run.outcome.get(name)
        return dict(found) if isinstance(found, Mapping) else {}

    paths = run.files.values()
    return Health(
        exit_codes=table("exit_codes"),
        restarts=table("restarts"),
        log_files=tuple(p.name for p in paths),
        log_bytes=sum(p.stat().st_size for p in paths),
        notes=run.notes,
    )
