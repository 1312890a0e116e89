"""Read one episode tick by tick from the TMC's log: cells, sightings and exchanges."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmc.analysis.run_config import world_of
from tmc.analysis.run_data import UNKNOWN
from tmc.kernel.grid import STAY
from tmc.kernel.reward import Block
from tmc.kernel.world import World
from tmc.record import overfly_pb2
from tmc.record.errors import RecordError
from tmc.record.reader import Log, decode
from tmc.record.run_folder import tmc_log
from tmc.record.schemas import foxglove

PROGRESS_MESSAGES = 10_000
"""Messages between two reports of progress."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """An episode up to tick T, the last one that is final for the whole team; N = `team.size`.

    `cells`: shape (T + 1, N); UNKNOWN where a UAV was lost.
    `actions`, `blocks`, `rewards` (by the UAV's own map): shape (T + 1, N), of the move that led to the tick.
    `policies`: shape (T + 1, N), version of the policy that chose the move.
    `seen`: {(tick, uav): cells of the peers sensed}. `answered`: {tick: UAVs that got the TMC's map}.
    `events`: {tick: cells}.
    `uncertainty`, `reward`: shape (T + 1,), as logged by the TMC: true map, summed over cells; mean per UAV.
    `roads`: the road network as GeoJSON; empty for a map without streets.
    `whole`: T is the end of the episode. `notes`: remarks on the run.
    `damage`: what is wrong with the log within the episode, or None. A log that still grows is not damaged.
    """

    world: World
    episode: int
    cells: NDArray[np.int64]
    actions: NDArray[np.uint8]
    blocks: NDArray[np.uint8]
    rewards: NDArray[np.float32]
    policies: NDArray[np.int64]
    seen: Mapping[tuple[int, int], list[int]]
    answered: Mapping[int, list[int]]
    events: Mapping[int, list[int]]
    uncertainty: NDArray[np.float64]
    reward: NDArray[np.float64]
    roads: str
    whole: bool
    notes: tuple[str, ...]
    damage: str | None

    @property
    def ticks(self) -> int:
        """T, the last tick."""
        return len(self.uncertainty) - 1


def read_timeline(folder: Path, episode: int, show: Callable[[str], None] = lambda _: None) -> Timeline:
    """Read one episode of a run; RecordError when the log holds nothing of it. `show` gets the progress in words."""
    path = tmc_log(folder)
    world, notes = world_of(folder, path)
    collector, log = _Collector(world, episode), Log(path)
    for number, raw in enumerate(log.raw(), start=1):
        handler = _HANDLERS.get(raw.schema)
        if handler is not None and collector.add(decode(raw), handler):
            break  # the episode is over, so nothing of it follows
        if raw.topic == "/map/roads":
            collector.roads = decode(raw, foxglove("GeoJSON").GeoJSON).geojson
        if number % PROGRESS_MESSAGES == 0:
            show(f"reading {path.name}: {number:,} messages")
    else:
        collector.damage = None if log.still_open else log.damage
    return collector.timeline(folder, tuple(notes))


class _Collector:
    """Collect the messages of one episode. Repeats overwrite equal values."""

    def __init__(self, world: World, episode: int) -> None:
        shape = (world.config.training.ticks + 1, world.config.team.size)
        self.world, self.episode, self.found = world, episode, set[int]()
        self.cells = np.full(shape, UNKNOWN, np.int64)
        self.actions, self.blocks = np.full(shape, STAY, np.uint8), np.zeros(shape, np.uint8)
        self.rewards, self.policies = np.zeros(shape, np.float32), np.zeros(shape, np.int64)
        self.seen: dict[tuple[int, int], list[int]] = {}
        self.answered: dict[int, list[int]] = {}
        self.events: dict[int, list[int]] = {}
        self.uncertainty, self.reward = np.full(shape[0], np.nan), np.full(shape[0], np.nan)
        self.roads = ""
        self.damage: str | None = None

    def add(self, message: Any, handler: Callable[[_Collector, Any], None]) -> bool:
        """Add a message if it is of the episode; return True once the episode is over."""
        self.found.add(message.episode)
        if message.episode == self.episode:
            try:
                handler(self, message)
            except (IndexError, ValueError):
                raise RecordError(
                    f"the log does not fit its config of {self.cells.shape[1]} UAVs and {len(self.cells) - 1} ticks: "
                    "the folder mixes two runs, so use neither"
                ) from None
        return message.episode == self.episode and getattr(message, "phase", "") == "end"

    def _record(self, m: overfly_pb2.FlightRecord) -> None:
        self._check_cells(*m.cells, *m.seen_cell)
        if (
            len(m.cells) != m.tick - m.first + 1
            or max(m.actions, default=0) > STAY
            or max(m.blocks, default=0) > max(Block)
        ):
            raise ValueError("a record that no UAV sends")
        ticks, moves = slice(m.first, m.tick + 1), slice(max(m.first, 1), m.tick + 1)
        self.cells[ticks, m.uav] = m.cells
        for table, values in ((self.actions, m.actions), (self.blocks, m.blocks), (self.rewards, m.rewards)):
            table[moves, m.uav] = values
        self.policies[ticks, m.uav] = m.policy
        seen: dict[tuple[int, int], list[int]] = defaultdict(list)
        for tick, cell in zip(m.seen_tick, m.seen_cell, strict=True):
            seen[tick, m.uav].append(cell)
        self.seen |= seen

    def _sync(self, m: overfly_pb2.Sync) -> None:
        if max(m.uavs, default=0) >= self.cells.shape[1]:
            raise IndexError("more UAVs than the team has")
        self.answered[m.tick] = list(m.uavs)

    def _metrics(self, m: overfly_pb2.TeamMetrics) -> None:
        ticks = slice(m.first, m.first + len(m.uncertainty))
        self.uncertainty[ticks], self.reward[ticks] = m.uncertainty, m.reward

    def _events(self, m: overfly_pb2.Events) -> None:
        self._check_cells(*m.cells)
        events: dict[int, list[int]] = defaultdict(list)
        for tick, cell in zip(m.ticks, m.cells, strict=True):
            events[tick].append(cell)
        self.events |= events

    def _ignore(self, _: overfly_pb2.Episode) -> None:
        """Add nothing: only the phase of the message matters, in `add`."""

    def _check_cells(self, *cells: int) -> None:
        if max(cells, default=0) >= self.world.grid.size:
            raise IndexError("a cell off the grid")

    def timeline(self, folder: Path, notes: tuple[str, ...]) -> Timeline:
        """Return the ticks that are final; RecordError when there are none."""
        final = np.flatnonzero(np.append(np.isnan(self.uncertainty), True))[0]
        if not final:
            known = f"{min(self.found)} to {max(self.found)}" if len(self.found) > 1 else "".join(map(str, self.found))
            advice = f"ask for {known}" if known else "nothing was flown"
            damaged = f" ({self.damage})" if self.damage else ""
            raise RecordError(f"{folder} holds no tick of episode {self.episode}: {advice}{damaged}")
        upto = slice(0, final)
        return Timeline(
            self.world, self.episode, self.cells[upto], self.actions[upto], self.blocks[upto], self.rewards[upto],
            self.policies[upto], self.seen, self.answered, self.events, self.uncertainty[upto], self.reward[upto],
            self.roads, bool(final == len(self.uncertainty)), notes, self.damage,
        )  # fmt: skip


_HANDLERS: dict[str, Callable[[_Collector, Any], None]] = {
    "overfly.FlightRecord": _Collector._record,
    "overfly.Sync": _Collector._sync,
    "overfly.TeamMetrics": _Collector._metrics,
    "overfly.Events": _Collector._events,
    "overfly.Episode": _Collector._ignore,
}
