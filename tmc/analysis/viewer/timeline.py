"""One episode tick by tick, from the TMC's log alone: where everybody was, what was sensed, and who was answered."""

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
from tmc.record.errors import RecordError
from tmc.record.reader import Log, decode
from tmc.record.run_folder import run_files

EVERY = 10_000
"""Messages read between two words of progress."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """An episode up to tick T, the last one that is final for the whole team; N = `team.size`.

    `cells`: shape (T + 1, N), UNKNOWN where a UAV was lost. `actions`, `blocks`, `rewards` (by the UAV's own map): the
    same shape, of the move that led to the tick. `policies`: the same shape, the version that chose it.
    `seen`: {(tick, uav): cells of the peers sensed}. `answered`: {tick: UAVs that the TMC gave its map}.
    `events`: {tick: cells}. `uncertainty`, `reward`: shape (T + 1,), the sum over cells of the true map and the mean of
    the team as the TMC logged them. `roads`: the road network as GeoJSON, empty for a map without streets.
    `whole`: T is the end of the episode. `notes`: what to know of the run. `damage`: what is wrong with its log within
    the episode, or None; a log that still grows is not damaged.
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
        """T."""
        return len(self.uncertainty) - 1


def read(folder: Path, episode: int, show: Callable[[str], None] = lambda _: None) -> Timeline:
    """Read one episode of a run; RecordError when the log has nothing of it. `show` gets words of progress."""
    path = run_files(folder).get("tmc")
    if path is None:
        raise RecordError(f"{folder} holds no tmc.mcap: give the folder of the run on the host where the TMC ran")
    world, notes = world_of(folder, path)
    gathered, log = _Gathered(world, episode), Log(path)
    for number, raw in enumerate(log.raw(), start=1):
        handler = _HANDLERS.get(raw.schema)
        if handler is not None and gathered.take(decode(raw), handler):
            break  # the episode is over, so nothing of it follows
        if raw.topic == "/map/roads":
            gathered.roads = decode(raw).geojson
        if number % EVERY == 0:
            show(f"reading {path.name}: {number:,} messages")
    else:
        gathered.damage = None if log.still_open else log.damage
    return gathered.timeline(folder, tuple(notes))


class _Gathered:
    """What the messages of one episode tell; repeats say the same again."""

    def __init__(self, world: World, episode: int) -> None:
        shape = (world.config.training.ticks + 1, world.config.team.size)
        self.world, self.episode, self.held = world, episode, set[int]()
        self.cells = np.full(shape, UNKNOWN, np.int64)
        self.actions, self.blocks = np.full(shape, STAY, np.uint8), np.zeros(shape, np.uint8)
        self.rewards, self.policies = np.zeros(shape, np.float32), np.zeros(shape, np.int64)
        self.seen: dict[tuple[int, int], list[int]] = {}
        self.answered: dict[int, list[int]] = {}
        self.events: dict[int, list[int]] = {}
        self.uncertainty, self.reward = np.full(shape[0], np.nan), np.full(shape[0], np.nan)
        self.roads = ""
        self.damage: str | None = None

    def take(self, message: Any, handler: Callable[[_Gathered, Any], None]) -> bool:
        """Take a message in, if it is of the episode; True once the episode is over."""
        self.held.add(message.episode)
        if message.episode == self.episode:
            try:
                handler(self, message)
            except (IndexError, ValueError):
                raise RecordError(
                    f"the log does not fit its config of {self.cells.shape[1]} UAVs and {len(self.cells) - 1} ticks: "
                    "the folder mixes two runs, so use neither"
                ) from None
        return message.episode == self.episode and getattr(message, "phase", "") == "end"

    def _record(self, m: Any) -> None:
        self._check_cells(*m.cells, *m.seen_cell)
        if (
            len(m.cells) != m.tick - m.first + 1
            or max(m.actions, default=0) > STAY
            or max(m.blocks, default=0) > max(Block)
        ):
            raise ValueError("a record that no UAV can send")
        ticks, moves = slice(m.first, m.tick + 1), slice(max(m.first, 1), m.tick + 1)
        self.cells[ticks, m.uav] = m.cells
        for table, values in ((self.actions, m.actions), (self.blocks, m.blocks), (self.rewards, m.rewards)):
            table[moves, m.uav] = values
        self.policies[ticks, m.uav] = m.policy
        seen: dict[tuple[int, int], list[int]] = defaultdict(list)
        for tick, cell in zip(m.seen_tick, m.seen_cell, strict=True):
            seen[tick, m.uav].append(cell)
        self.seen |= seen

    def _sync(self, m: Any) -> None:
        if max(m.uavs, default=0) >= self.cells.shape[1]:
            raise IndexError("more UAVs than the team has")
        self.answered[m.tick] = list(m.uavs)

    def _metrics(self, m: Any) -> None:
        ticks = slice(m.first, m.first + len(m.uncertainty))
        self.uncertainty[ticks], self.reward[ticks] = m.uncertainty, m.reward

    def _events(self, m: Any) -> None:
        self._check_cells(*m.cells)
        events: dict[int, list[int]] = defaultdict(list)
        for tick, cell in zip(m.ticks, m.cells, strict=True):
            events[tick].append(cell)
        self.events |= events

    def _begins_or_ends(self, _: Any) -> None:
        """Only that it does matters."""

    def _check_cells(self, *cells: int) -> None:
        if max(cells, default=0) >= self.world.grid.size:
            raise IndexError("a cell off the grid")

    def timeline(self, folder: Path, notes: tuple[str, ...]) -> Timeline:
        """The ticks that are final; RecordError when there are none."""
        final = np.flatnonzero(np.append(np.isnan(self.uncertainty), True))[0]
        if not final:
            known = f"{min(self.held)} to {max(self.held)}" if len(self.held) > 1 else "".join(map(str, self.held))
            flown = f"ask for {known}" if known else "nothing was flown"
            damaged = f" ({self.damage})" if self.damage else ""
            raise RecordError(f"{folder} holds no tick of episode {self.episode}: {flown}{damaged}")
        upto = slice(0, final)
        return Timeline(
            self.world, self.episode, self.cells[upto], self.actions[upto], self.blocks[upto], self.rewards[upto],
            self.policies[upto], self.seen, self.answered, self.events, self.uncertainty[upto], self.reward[upto],
            self.roads, bool(final == len(self.uncertainty)), notes, self.damage,
        )  # fmt: skip


_HANDLERS: dict[str, Callable[[_Gathered, Any], None]] = {
    "overfly.FlightRecord": _Gathered._record,
    "overfly.Sync": _Gathered._sync,
    "overfly.TeamMetrics": _Gathered._metrics,
    "overfly.Events": _Gathered._events,
    "overfly.Episode": _Gathered._begins_or_ends,
}
