"""Read the logs of a run into arrays, in one pass per file. Of a file that is cut, what is intact is read."""

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
from tmc.record import overfly_pb2
from tmc.record.channels import ACTIVE
from tmc.record.errors import RecordError
from tmc.record.queries import Tracks
from tmc.record.reader import Log, decode
from tmc.record.run_folder import RunFolder, run_files, tmc_log

UNKNOWN = -1
"""In `Episode.cells`: no record holds the cell of the UAV."""
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode, as far as the log holds it; T = `training.ticks`, N = `team.size`.

    `cells`: shape (T + 1, N), cell by tick and UAV, or UNKNOWN.
    `uncertainty`: shape (T + 1,), of the true map, summed over cells, by tick; NaN where the log has none.
    `reward`: shape (T + 1,), mean per UAV, by tick; NaN where the log has none.
    `events`: shape (E, 2), tick and cell of each.
    `blocks`: number of moves by `Block`.
    `epsilon`, `updates` (so far): None before the end of the episode.
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
        """The number of ticks from 1 on whose uncertainty is known."""
        return int(np.isfinite(self.uncertainty[1:]).sum())

    @property
    def complete(self) -> bool:
        """True when every tick is known."""
        return self.ticks == self.uncertainty.size - 1


@dataclass(frozen=True, eq=False)
class Learning:
    """The learner's metrics, by update; shapes (U,). `q_mean`, `target_mean` are NaN where only the TMC logged."""

    updates: NDArray[np.int64]
    loss: Floats
    q_mean: Floats
    target_mean: Floats


@dataclass(frozen=True, eq=False)
class RunData:
    """A run, read.

    `updates`: of the network, by the log that holds most. `seconds`: working time of its processes, by a monotonic
    clock, without the time between incarnations. `files`: {process: log}. `outcome`: run.json, empty without one.
    `notes`: what is wrong with the logs, one sentence each; empty when all were closed in order.
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
        """Return one episode; RecordError when the log holds nothing of it."""
        for episode in self.episodes:
            if episode.number == number:
                return episode
        first, last = self.episodes[0].number, self.episodes[-1].number
        raise RecordError(f"{self.folder} holds nothing of episode {number}: ask for one of {first} to {last}")


def read(folder: Path) -> RunData:
    """Read a run folder; RecordError when it is not one, or holds no flight."""
    files = run_files(folder)
    world, notes = world_of(folder, tmc_log(folder))
    collector = _Collector()
    for path in files.values():
        notes += collector.read(path)
    episodes = collector.episodes(world)
    if not episodes:
        raise RecordError(f"{folder} holds no flight: its mission ended before the first flight records arrived")
    span = max(collector.flying.total, collector.learning.total)
    learning = _learning(collector.learner or collector.policies)
    return RunData(folder, world, episodes, learning, collector.updates, span, files, _outcome(folder), tuple(notes))


def _outcome(folder: Path) -> dict[str, Any]:
    """Return run.json; empty where there is none, or an incomplete one."""
    try:
        found = json.loads(read_text(RunFolder(folder).outcome))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


@dataclass
class Elapsed:
    """Add up the working time of the incarnations of a process, s. Each counts its own from 0."""

    before: float = 0.0
    last: float = 0.0

    def update(self, seconds: float) -> None:
        """Note the time of the current incarnation, s. A time that goes back is that of the next one."""
        if seconds < self.last:
            self.before += self.last
        self.last = seconds

    @property
    def total(self) -> float:
        """The time of all incarnations, s."""
        return self.before + self.last


@dataclass
class _Collector:
    """Sort the messages of a run by episode, and drop repeats."""

    tracks: dict[int, Tracks] = field(default_factory=dict)
    blocks: dict[int, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))
    metrics: dict[int, list[overfly_pb2.TeamMetrics]] = field(default_factory=lambda: defaultdict(list))
    events: dict[int, set[tuple[int, int]]] = field(default_factory=lambda: defaultdict(set))
    ends: dict[int, overfly_pb2.Episode] = field(default_factory=dict)
    learner: dict[int, tuple[float, ...]] = field(default_factory=dict)
    policies: dict[int, tuple[float, ...]] = field(default_factory=dict)
    known: set[tuple[int, int]] = field(default_factory=set)
    updates: int = 0
    flying: Elapsed = field(default_factory=Elapsed)
    learning: Elapsed = field(default_factory=Elapsed)

    def read(self, path: Path) -> list[str]:
        """Read one file; return what is wrong with it."""
        try:
            log = Log(path)
        except RecordError as error:  # empty, or not a log: the rest of the run can still be read
            return [str(error)]
        for raw in log.raw():
            handler = _HANDLERS.get(raw.schema)
            if handler is not None:
                handler(self, decode(raw))
        if log.damage:
            return [log.damage]
        still = f"{path.name}: not closed: its process is still running, or was killed"
        return [still] if path.name.endswith(ACTIVE) and not log.finished else []

    def _record(self, m: overfly_pb2.FlightRecord) -> None:
        if (m.uav, m.sequence) not in self.known:
            self.known.add((m.uav, m.sequence))
            self.tracks.setdefault(m.episode, Tracks(m.episode)).add(m)
            self.blocks[m.episode].update(m.blocks)

    def _metrics(self, m: overfly_pb2.TeamMetrics) -> None:
        self.updates = max(self.updates, m.updates)
        self.flying.update(m.elapsed)
        self.metrics[m.episode].append(m)

    def _events(self, m: overfly_pb2.Events) -> None:
        self.events[m.episode].update(zip(m.ticks, m.cells, strict=True))

    def _episode(self, m: overfly_pb2.Episode) -> None:
        self.updates = max(self.updates, m.updates)
        if m.phase == "end":
            self.ends[m.episode] = m

    def _learner(self, m: overfly_pb2.LearnerMetrics) -> None:
        self.updates = max(self.updates, m.updates)
        self.learning.update(m.wall)
        self.learner[m.updates] = (m.loss, m.q_mean, m.target_mean)

    def _policy(self, m: overfly_pb2.Policy) -> None:
        self.updates = max(self.updates, m.updates)
        if m.updates:
            self.policies[m.updates] = (m.loss, np.nan, np.nan)

    def episodes(self, world: World) -> tuple[Episode, ...]:
        """Return the episodes of which at least one tick is final for all UAVs."""
        found = (self._episode_of(number, world) for number in sorted(self.tracks))
        return tuple(episode for episode in found if episode.ticks)

    def _episode_of(self, number: int, world: World) -> Episode:
        end, T = self.ends.get(number), world.config.training.ticks
        uncertainty, reward = np.full(T + 1, np.nan), np.full(T + 1, np.nan)
        for m in self.metrics[number]:
            span = slice(m.first, m.first + len(m.uncertainty))
            _require(world, span.stop <= T + 1)
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


_HANDLERS: dict[str, Callable[[_Collector, Any], None]] = {
    "overfly.FlightRecord": _Collector._record,
    "overfly.TeamMetrics": _Collector._metrics,
    "overfly.Events": _Collector._events,
    "overfly.Episode": _Collector._episode,
    "overfly.LearnerMetrics": _Collector._learner,
    "overfly.Policy": _Collector._policy,
}


def _cells(tracks: Tracks, world: World) -> NDArray[np.int64]:
    """Return the cells by tick and UAV, UNKNOWN without a record; shape (T + 1, N)."""
    T, N, K = world.config.training.ticks, world.config.team.size, world.grid.size
    ticks, uavs, cells = tracks.rows().astype(np.int64).T
    _require(world, bool((ticks <= T).all() and (uavs < N).all() and (cells < K).all()))
    table = np.full((T + 1, N), UNKNOWN, np.int64)
    table[ticks, uavs] = cells
    return table


def _require(world: World, fits: bool) -> None:
    if not fits:
        team, ticks = world.config.team.size, world.config.training.ticks
        raise RecordError(
            f"the log does not fit its config of {team} UAVs, {ticks} ticks and {world.grid.size} cells: "
            "the folder mixes two runs, so use neither"
        )


def _learning(by_update: Mapping[int, Iterable[float]]) -> Learning:
    """Sort by update. A learner that resumed from a checkpoint did some updates twice: the last time counts."""
    updates = np.array(sorted(by_update), np.int64)
    values = np.array([tuple(by_update[int(u)]) for u in updates], np.float64).reshape(-1, 3)
    return Learning(updates, values[:, 0], values[:, 1], values[:, 2])
