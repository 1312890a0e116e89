"""Build the observation o_i(t) = [P_i(t), M, U_i(t)] (eq. 12). A UAV and the replay memory build the same bits.

Channels: P, ego 1.0 and sensed peers 0.5; M, road 1, free 0, blocked or off the grid -1; U, the UAV's own map. The
view is the whole grid, or the square of `2 radius + 1` cells around the UAV.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.grid import ACTIONS, OFF_GRID, STAY
from tmc.kernel.policy import view_shape
from tmc.kernel.world import World

EGO, PEER = 1.0, 0.5

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Views:
    """The content of B observations. It is sent instead of images: an eighth of the size with the paper's map.

    `cells` (B,) uint16: cell of the UAV. `peers` (B, P) uint16: cells of the sensed UAVs; K where there are fewer.
    `u` (B, R) float32: the UAV's own map, over the monitored cells.
    """

    cells: NDArray[np.uint16]
    peers: NDArray[np.uint16]
    u: Floats

    def rows(self, which: slice | NDArray[np.int64]) -> Views:
        """Return a subset, by slice or index."""
        return Views(self.cells[which], self.peers[which], self.u[which])


def allowed_in(observation: Floats) -> list[int]:
    """Actions that nothing shown in an observation (3, H, W) blocks, as `ObservationBuilder.allowed` lists them.

    Staying is always among them.
    """
    place, terrain = observation[0], observation[1]
    height, width = place.shape
    row, col = divmod(int((place == EGO).argmax()), width)

    def is_free(r: int, c: int) -> bool:
        return bool(0 <= r < height and 0 <= c < width and terrain[r, c] >= 0.0 and place[r, c] != PEER)

    return [a for a, (_, dr, dc) in enumerate(ACTIONS) if a == STAY or is_free(row + dr, col + dc)]


class ObservationBuilder:
    """Build observations of one world. Holds tables, no state."""

    def __init__(self, world: World) -> None:
        config, grid = world.config, world.grid
        self.grid = grid
        self.shape = view_shape(config, grid)
        self.sensing = np.inf if config.scenario == 1 else config.team.sensing_range
        """r_s in cell widths; infinite in scenario I, where every UAV knows all positions (Sec. II-C)."""
        self._whole = config.observation.view == "whole"
        K, R = grid.size, world.law.cells.size
        self.R = R
        """The number of monitored cells."""
        window = np.arange(K)[None, :] if self._whole else grid.window(config.observation.radius)
        self._window = window.astype(np.int64)
        terrain = np.where(world.map.blocked, -1.0, np.where(world.map.road, 1.0, 0.0))
        self._terrain = np.append(terrain, -1.0).astype(np.float32)[self._window]
        blank = np.stack([np.zeros_like(self._terrain[0]), self._terrain[0], np.zeros_like(self._terrain[0])])
        self._blank = blank, np.ascontiguousarray(blank.T).T
        """An image of the terrain alone, (3, K), with channels first and with channels last in memory. An image in
        the same order is copied in one step."""
        index = np.append(np.where(world.law.index < 0, R, world.law.index), R)
        self._index = index[self._window].astype(np.int64)
        self._monitored = world.law.cells.astype(np.int64)
        targets = np.where(grid.targets == OFF_GRID, 0, grid.targets)
        self.free = (grid.targets != OFF_GRID) & ~world.map.blocked[targets]
        """Moves that neither the grid's edge nor an obstacle blocks; shape (K, 9), bool."""
        self._free_lists = [[a for a in range(STAY + 1) if row[a]] for row in self.free]
        self._rows, self._cols = np.divmod(np.arange(K + 1), grid.cols)

    def observe(self, cell: int, peers: list[int], u: NDArray[np.float64], out: Floats | None = None) -> Floats:
        """Return o_i(t), shape (C, H, W), float32; drawn into `out` when given.

        `peers`: cells of the sensed UAVs. `u`: the UAV's own map, shape (R,).
        """
        flat = np.empty((3, self._window.shape[1]), np.float32) if out is None else out.reshape(3, -1)
        row = 0 if self._whole else cell
        flat[1] = self._terrain[row]
        padded = np.zeros(u.size + 1)
        padded[:-1] = u
        flat[2] = padded[self._index[row]]
        flat[0] = 0.0
        for peer in peers:
            self._mark(flat[0], cell, peer, PEER)
        self._mark(flat[0], cell, cell, EGO)
        return flat.reshape(self.shape)

    @property
    def first_cell(self) -> int:
        """A cell on which a UAV may be."""
        return int(self._monitored[0])

    def canvas(self) -> Canvas:
        """Return an image that is drawn again at each tick."""
        return Canvas(self, self._monitored if self._whole else None)

    def _mark(self, plane: Floats, cell: int, where: int, value: float) -> None:
        if self._whole:
            plane[where] = value
            return
        (r0, c0), (r, c) = divmod(cell, self.grid.cols), divmod(where, self.grid.cols)
        side = self.shape[1]
        y, x = r - r0 + side // 2, c - c0 + side // 2
        if 0 <= y < side and 0 <= x < side:
            plane[y * side + x] = value

    def allowed(self, cell: int, peers: list[int]) -> list[int]:
        """Return the actions that neither grid, obstacles nor sensed peers block. Never empty: the UAV may stay."""
        targets = self.grid.target_lists[cell]
        return [a for a in self._free_lists[cell] if targets[a] not in peers]

    def sensed(self, cells: Ints, team: Ints, uav: Ints) -> NDArray[np.bool_]:
        """Return N_i(t) for a batch, True where the other UAV is within r_s; (B,), (B, N), (B,) -> (B, N), bool."""
        if np.isinf(self.sensing):
            near = np.ones(team.shape, bool)
        else:
            dr = self._rows[team] - self._rows[cells][:, None]
            dc = self._cols[team] - self._cols[cells][:, None]
            near = dr * dr + dc * dc <= self.sensing * self.sensing + 1e-9
        near &= team < self.grid.size  # K stands for a lost UAV
        near[np.arange(len(uav)), uav] = False
        return near

    def views(self, cells: Ints, team: Ints, uav: Ints, u: Floats) -> Views:
        """Return the views of UAVs `uav`; shapes (B,), (B, N), (B,), (B, R)."""
        peers = np.sort(np.where(self.sensed(cells, team, uav), team, self.grid.size), axis=1)
        columns = int((peers < self.grid.size).sum(axis=1).max(initial=0))
        return Views(cells.astype("<u2"), peers[:, :columns].astype("<u2"), u)

    def observe_batch(self, views: Views, images: Floats | None = None) -> Floats:
        """Return the observations of a batch, (B, C, H, W), float32, the same bits as `observe`.

        Drawn into `images` when given, which may have any memory order, such as channels last.
        """
        B, cells, u = views.cells.size, views.cells.astype(np.int64), views.u
        drawn = np.empty((B, *self.shape), np.float32) if images is None else images
        out = drawn.reshape(B, 3, -1)
        out[...] = self._blank[out.strides[1] < out.strides[2]] if self._whole else 0.0
        batch, peer = np.nonzero(views.peers < self.grid.size)
        self._mark_batch(out, batch, cells[batch], views.peers[batch, peer].astype(np.int64), PEER)
        self._mark_batch(out, np.arange(B), cells, cells, EGO)
        if self._whole:  # writes the monitored cells only, in a third of the time of a gather
            out[:, 2][:, self._monitored] = u
        else:
            padded = np.zeros((B, u.shape[1] + 1), np.float32)
            padded[:, :-1] = u
            out[:, 1] = self._terrain[cells]
            out[:, 2] = padded.ravel().take(self._index[cells] + np.arange(0, padded.size, padded.shape[1])[:, None])
        return drawn

    def _mark_batch(self, out: Floats, batch: Ints, cells: Ints, where: Ints, value: float) -> None:
        """Do as `_mark`, for images `batch` of UAVs on `cells`; shapes (n,)."""
        if self._whole:
            out[batch, 0, where] = value
            return
        side = self.shape[1]
        y = self._rows[where] - self._rows[cells] + side // 2
        x = self._cols[where] - self._cols[cells] + side // 2
        seen = (y >= 0) & (y < side) & (x >= 0) & (x < side)
        out[batch[seen], 0, (y * side + x)[seen]] = value

    def allowed_batch(self, views: Views) -> NDArray[np.uint8]:
        """Return 1 for the actions that `allowed` lists; shape (B, 9), uint8."""
        targets = self.grid.targets[views.cells]
        held = (targets[:, :, None] == views.peers[:, None, :]).any(axis=2)
        return np.asarray(self.free[views.cells] & ~held, np.uint8)


class Canvas:
    """Draw o_i(t) over and over into one image, the same bits as `ObservationBuilder.observe`; draw only what changes.

    `monitored`: the cells of U in a view of the whole grid; None where the view moves with the UAV.
    """

    def __init__(self, observer: ObservationBuilder, monitored: Ints | None) -> None:
        self.image = np.zeros((1, *observer.shape), np.float32)
        """Shape (1, C, H, W), always the same memory."""
        self._observer, self._monitored = observer, monitored
        self._here, _, self._u = self.image.reshape(3, -1)
        self._marked: list[int] | None = None

    def draw(self, cell: int, peers: list[int], u: NDArray[np.float64]) -> None:
        """Draw o_i(t); arguments as for `ObservationBuilder.observe`."""
        if self._monitored is None or self._marked is None:
            self._observer.observe(cell, peers, u, self.image[0])
        else:
            for where in self._marked:
                self._here[where] = 0.0
            for where in peers:
                self._here[where] = PEER
            self._here[cell] = EGO
            self._u[self._monitored] = u
        self._marked = [cell, *peers]
