"""What was flown: a run folder's logs as arrays, in one pass a file. Finished, still written or cut: what is intact."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmc.analysis.run_config import world_of
from tmc.kernel.files import read_text
from tmc.kernel.world import World
from tmc.record.channels import ACTIVE
from tmc.record.errors import RecordError
from tmc.record.queries import Tracks
from tmc.record.reader import Log, decode
from tmc.record.run_folder import run_files

UNKNOWN = -1
"""In `Episode.cells`: the log does not say where the UAV was."""
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode, as far as the log holds it; T = `training.ticks`, N = `team.size`.

    `cells`: shape (T + 1, N), cell by tick and UAV, or UNKNOWN. `uncertainty`, `reward`: shape (T + 1,), the sum over
    cells of the true map and the mean of the team by tick, NaN where the log has none. `events`: shape (E, 2), tick and
    cell of each. `blocks`: moves by `Block`. `epsilon`, `updates` (so far): None before the episode's end.
    """

    number: int
    cells: NDArray[np.int64]
    uncertainty: Floats
    reward: Floats
    events: NDArray[np.int64]
    blocks: Mapping[int, int]
    epsilon: float | None
    updates: int | None

    @property
    def ticks(self) -> int:
        """Ticks, from 1 on, whose uncertainty is known."""
        return int(np.isfinite(self.uncertainty[1:]).sum())

    @property
    def complete(self) -> bool:
        """True when every tick is known."""
        return self.ticks == self.uncertainty.size - 1


@dataclass(frozen=True, eq=False)
class Learning:
    """How learning went, by update: arrays of one length; `q_mean`, `target_mean` are NaN where only the TMC logged."""

    updates: NDArray[np.int64]
    loss: Floats
    q_mean: Floats
    target_mean: Floats


@dataclass(frozen=True, eq=False)
class RunData:
    """A run. `updates`: of the network, as far as any log says. `outcome`: run.json, empty without one.

    `seconds`: how long its processes were at work, by a clock that is never set, without the time between them.
    `notes`: sentences on what is wrong with the logs; empty when all were closed in order.
    """

    folder: Path
    world: World
    episodes: tuple[Episode, ...]
    learning: Learning
    updates: int
    seconds: float
    files: Mapping[str, Path]
    outcome: Mapping[str, Any]
    notes: tuple[str, ...]

    def episode(self, number: int) -> Episode:
        """One episode; RecordError when the log has nothing of it."""
        for episode in self.episodes:
            if episode.number == number:
                return episode
        first, last = self.episodes[0].number, self.episodes[-1].number
        raise RecordError(f"{self.folder} holds nothing of episode {number}: ask for one of {first} to {last}")


def read(folder: Path) -> RunData:
    """Read a run folder; RecordError when it is none, or when nothing was flown in it."""
    files = run_files(folder)
    if "tmc" not in files:
        raise RecordError(f"{folder} holds no tmc.mcap: give the folder of the run on the host where the TMC ran")
    world, notes = world_of(folder, files["tmc"])
    gathered = _Gathered()
    for path in files.values():
        notes += gathered.take(path)
    episodes = gathered.episodes(world)
    if not episodes:
        raise RecordError(f"{folder} holds no flight: its mission ended before the first records came in")
    span = max(gathered.flying.total, gathered.learning.total)
    learning = _learning(gathered.learner or gathered.policies)
    return RunData(folder, world, episodes, learning, gathered.updates, span, files, _outcome(folder), tuple(notes))


def _outcome(folder: Path) -> dict[str, Any]:
    """run.json; empty where there is none, or none yet that is whole."""
    try:
        found = json.loads(read_text(folder / "run.json"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


@dataclass
class Elapsed:
    """Seconds that one process after the other was at work, each counting its own from 0."""

    before: float = 0.0
    last: float = 0.0

    def take(self, seconds: float) -> None:
        """One process's seconds so far; fewer than before are those of the next process."""
        if seconds < self.last:
            self.before += self.last
        self.last = seconds

    @property
    def total(self) -> float:
        """Of all processes."""
        return self.before + self.last


@dataclass
class _Gathered:
    """Messages of a run as they come, sorted by episode; repeats are dropped."""

    tracks: dict[int, Tracks] = field(default_factory=dict)
    blocks: dict[int, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))
    metrics: dict[int, list[Any]] = field(default_factory=lambda: defaultdict(list))
    events: dict[int, set[tuple[int, int]]] = field(default_factory=lambda: defaultdict(set))
    ends: dict[int, Any] = field(default_factory=dict)
    learner: dict[int, tuple[float, ...]] = field(default_factory=dict)
    policies: dict[int, tuple[float, ...]] = field(default_factory=dict)
    known: set[tuple[int, int]] = field(default_factory=set)
    updates: int = 0
    flying: Elapsed = field(default_factory=Elapsed)
    learning: Elapsed = field(default_factory=Elapsed)

    def take(self, path: Path) -> list[str]:
        """Read one file; returns what is wrong with it."""
        try:
            log = Log(path)
        except RecordError as error:  # empty, or no log at all: the rest of the run is still worth reading
            return [str(error)]
        for raw in log.raw():
            handler = _HANDLERS.get(raw.schema)
            if handler is not None:
                handler(self, decode(raw))
        if log.damage:
            return [log.damage]
        still = f"{path.name}: not closed, so the mission goes on or its process was killed"
        return [still] if path.name.endswith(ACTIVE) and not log.finished else []

    def _record(self, m: Any) -> None:
        if (m.uav, m.sequence) not in self.known:
            self.known.add((m.uav, m.sequence))
            self.tracks.setdefault(m.episode, Tracks(m.episode)).add(m)
            self.blocks[m.episode].update(m.blocks)

    def _metrics(self, m: Any) -> None:
        self.updates = max(self.updates, m.updates)
        self.flying.take(m.elapsed)
        self.metrics[m.episode].append(m)

    def _events(self, m: Any) -> None:
        self.events[m.episode].update(zip(m.ticks, m.cells, strict=True))

    def _episode(self, m: Any) -> None:
        self.updates = max(self.updates, m.updates)
        if m.phase == "end":
            self.ends[m.episode] = m

    def _learner(self, m: Any) -> None:
        self.updates = max(self.updates, m.updates)
        self.learning.take(m.wall)
        self.learner[m.updates] = (m.loss, m.q_mean, m.target_mean)

    def _policy(self, m: Any) -> None:
        self.updates = max(self.updates, m.updates)
        if m.updates:
            self.policies[m.updates] = (m.loss, np.nan, np.nan)

    def episodes(self, world: World) -> tuple[Episode, ...]:
        """Those of which at least one tick was flown by all UAVs."""
        found = (self._made(number, world) for number in sorted(self.tracks))
        return tuple(episode for episode in found if episode.ticks)

    def _made(self, number: int, world: World) -> Episode:
        end, T = self.ends.get(number), world.config.training.ticks
        uncertainty, reward = np.full(T + 1, np.nan), np.full(T + 1, np.nan)
        for m in self.metrics[number]:
            span = slice(m.first, m.first + len(m.uncertainty))
            _fits(world, span.stop <= T + 1)
            uncertainty[span], reward[span] = m.uncertainty, m.reward
        return Episode(
            number,
            _cells(self.tracks[number], world),
            uncertainty,
            reward,
            np.array(sorted(self.events[number]), np.int64).reshape(-1, 2),
            dict(self.blocks[number]),
            None if end is None else end.epsilon,
            None if end is None else end.updates,
        )


_HANDLERS: dict[str, Callable[[_Gathered, Any], None]] = {
    "overfly.FlightRecord": _Gathered._record,
    "overfly.TeamMetrics": _Gathered._metrics,
    "overfly.Events": _Gathered._events,
    "overfly.Episode": _Gathered._episode,
    "overfly.LearnerMetrics": _Gathered._learner,
    "overfly.Policy": _Gathered._policy,
}


def _cells(tracks: Tracks, world: World) -> NDArray[np.int64]:
    """Shape (T + 1, N), UNKNOWN where there is no record."""
    T, N, K = world.config.training.ticks, world.config.team.size, world.grid.size
    ticks, uavs, cells = tracks.rows().astype(np.int64).T
    _fits(world, bool((ticks <= T).all() and (uavs < N).all() and (cells < K).all()))
    table = np.full((T + 1, N), UNKNOWN, np.int64)
    table[ticks, uavs] = cells
    return table


def _fits(world: World, good: bool) -> None:
    if not good:
        team, ticks = world.config.team.size, world.config.training.ticks
        raise RecordError(
            f"the log does not fit its config of {team} UAVs, {ticks} ticks and {world.grid.size} cells: "
            "the folder mixes two runs, so use neither"
        )


def _learning(by_update: Mapping[int, Iterable[float]]) -> Learning:
    """A learner that came back from a checkpoint did some updates twice: the last time counts."""
    updates = np.array(sorted(by_update), np.int64)
    values = np.array([tuple(by_update[int(u)]) for u in updates], np.float64).reshape(-1, 3)
    return Learning(updates, values[:, 0], values[:, 1], values[:, 2])
