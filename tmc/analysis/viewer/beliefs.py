"""Recompute the maps of an episode at each tick: the true one, the TMC's, and each UAV's own (Sec. II-D).

At tick t a UAV marks its own cell and those of the peers it senses. At an exchange, the TMC first adds the visits that
the UAV reports. The UAV then merges the TMC's map into its own: the later visit counts. With that map it acts at t.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmc.analysis.run_data import UNKNOWN
from tmc.analysis.viewer.timeline import Timeline
from tmc.kernel.uncertainty import merge

TRUE, TMC, UAV = 0, 1, 2
"""Rows of a `Maps`: the true map, the TMC's, and from row UAV on each UAV's own."""


@dataclass(frozen=True, eq=False)
class Maps:
    """All maps at a tick, over the R monitored cells; shapes (2 + N, R).

    `last_visit`: ticks. `uncertainty`: u_k(t) of each cell; in scenario I, 1 where an event is known to be active.
    `exchanged`: for each UAV the tick of its last exchange, 0 before the first.
    """

    tick: int
    last_visit: NDArray[np.uint16]
    uncertainty: NDArray[np.float64]
    exchanged: tuple[int, ...]

    @property
    def sums(self) -> NDArray[np.float64]:
        """The uncertainty, summed over cells; shape (2 + N,)."""
        return np.asarray(self.uncertainty.sum(axis=1))


def maps(timeline: Timeline) -> Iterator[Maps]:
    """Yield the maps at ticks 0..T."""
    state = _State(timeline)
    for tick in range(timeline.ticks + 1):
        yield state.advance(tick)


class _State:
    """The maps at the current tick. A lost UAV keeps its last one."""

    def __init__(self, timeline: Timeline) -> None:
        world, N = timeline.world, timeline.cells.shape[1]
        self.timeline, self.law, self.scenario = timeline, world.law, world.config.scenario
        self.factor = world.initial_factor(timeline.episode)
        self.last_visit = np.zeros((UAV + N, self.law.cells.size), np.uint16)
        self.active = np.zeros(self.last_visit.shape, bool)
        self.known_until = [-1] * N
        """By UAV, the last tick whose cell the TMC knows; -1 for none."""

    def advance(self, t: int) -> Maps:
        """Advance to tick t, the next one, and return its maps."""
        for i, cell in enumerate(self.timeline.cells[t].tolist()):
            if cell != UNKNOWN:
                self._visit(TRUE, cell, t)
                for known in (cell, *self.timeline.seen.get((t, i), ())):
                    self._visit(UAV + i, known, t)
        self._events(t)
        self._exchange(t, self.timeline.answered.get(t, []))
        return Maps(t, self.last_visit.copy(), self._uncertainty(t), tuple(max(tick, 0) for tick in self.known_until))

    def _visit(self, row: int, cell: int, t: int) -> None:
        k = -1 if cell == UNKNOWN else self.law.index_list[cell]
        if k >= 0:
            self.last_visit[row, k] = max(self.last_visit[row, k], t)

    def _events(self, t: int) -> None:
        """Clear the visited cells, then add the events of the tick (scenario I)."""
        index, cells = self.law.index, self.timeline.cells[t]
        visited = index[cells[cells != UNKNOWN]]
        self.active[TRUE, visited[visited >= 0]] = False
        self.active[TRUE, index[self.timeline.events.get(t, [])]] = True

    def _exchange(self, t: int, answered: list[int]) -> None:
        for i in answered:
            for tick in range(self.known_until[i] + 1, t + 1):
                self._visit(TMC, int(self.timeline.cells[tick, i]), tick)
            self.known_until[i] = t
        rows = [UAV + i for i in answered]
        if self.scenario == 2:
            self.last_visit[rows] = merge(self.last_visit[rows], self.last_visit[TMC])
        elif answered:
            self.active[[TMC, *rows]] = self.active[TRUE]

    def _uncertainty(self, t: int) -> NDArray[np.float64]:
        if self.scenario == 1:
            return self.active.astype(np.float64)
        return self.law.values(self.last_visit, t, self.factor)
