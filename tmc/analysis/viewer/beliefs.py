"""The maps of an episode at each tick: the true one, the TMC's, and each UAV's own, from what was flown (Sec. II-D).

At tick t a UAV marks its own cell and those of the peers it senses. Where the TMC answers it at t, the TMC first takes
in the visits that the UAV has told it of, and the UAV then merges the TMC's map into its own, the later visit wins:
that is the map it acts on at t.
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
"""Rows of a `Maps`: the true map, the TMC's, and from UAV on each UAV's own."""


@dataclass(frozen=True, eq=False)
class Maps:
    """All maps at a tick, over the R monitored cells; shapes (2 + N, R).

    `last_visit`: ticks. `uncertainty`: u_k(t) of each cell; in scenario I 1 where an event is active as far as known.
    `exchanged`: for each UAV the tick of its last exchange, 0 before the first.
    """

    tick: int
    last_visit: NDArray[np.uint16]
    uncertainty: NDArray[np.float64]
    exchanged: tuple[int, ...]

    @property
    def sums(self) -> NDArray[np.float64]:
        """Shape (2 + N,): the uncertainty, summed over cells."""
        return np.asarray(self.uncertainty.sum(axis=1))


def maps(flown: Timeline) -> Iterator[Maps]:
    """The maps at ticks 0..T in turn."""
    state = _State(flown)
    for tick in range(flown.ticks + 1):
        yield state.advance(tick)


class _State:
    """The maps as they are now. A UAV that was lost keeps its last one."""

    def __init__(self, flown: Timeline) -> None:
        world, N = flown.world, flown.cells.shape[1]
        self.flown, self.law, self.scenario = flown, world.law, world.config.scenario
        self.factor = world.initial_factor(flown.episode)
        self.last_visit = np.zeros((UAV + N, self.law.cells.size), np.uint16)
        self.active = np.zeros(self.last_visit.shape, bool)
        self.told = [-1] * N
        """The tick up to which the TMC knows where a UAV was."""

    def advance(self, t: int) -> Maps:
        """Go on to tick t, the next one."""
        for i, cell in enumerate(self.flown.cells[t].tolist()):
            if cell != UNKNOWN:
                self._visit(TRUE, cell, t)
                for known in (cell, *self.flown.seen.get((t, i), ())):
                    self._visit(UAV + i, known, t)
        self._events(t)
        self._exchange(t, self.flown.answered.get(t, []))
        return Maps(t, self.last_visit.copy(), self._uncertainty(t), tuple(max(told, 0) for told in self.told))

    def _visit(self, row: int, cell: int, t: int) -> None:
        k = -1 if cell == UNKNOWN else self.law.index_list[cell]
        if k >= 0:
            self.last_visit[row, k] = max(self.last_visit[row, k], t)

    def _events(self, t: int) -> None:
        """Scenario I: the cells visited are cleared, then the events of the slot appear."""
        index, cells = self.law.index, self.flown.cells[t]
        visited = index[cells[cells != UNKNOWN]]
        self.active[TRUE, visited[visited >= 0]] = False
        self.active[TRUE, index[self.flown.events.get(t, [])]] = True

    def _exchange(self, t: int, answered: list[int]) -> None:
        for i in answered:
            for tick in range(self.told[i] + 1, t + 1):
                self._visit(TMC, int(self.flown.cells[tick, i]), tick)
            self.told[i] = t
        rows = [UAV + i for i in answered]
        if self.scenario == 2:
            self.last_visit[rows] = merge(self.last_visit[rows], self.last_visit[TMC])
        elif answered:
            self.active[[TMC, *rows]] = self.active[TRUE]

    def _uncertainty(self, t: int) -> NDArray[np.float64]:
        if self.scenario == 1:
            return self.active.astype(np.float64)
        return self.law.values(self.last_visit, t, self.factor)
