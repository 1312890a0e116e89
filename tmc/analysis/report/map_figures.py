"""Draw the map, and the paths of an episode over the uncertainty at its end."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from tmc.analysis import palette
from tmc.analysis.report import style
from tmc.analysis.run_data import UNKNOWN, Episode
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World

PATH_TICKS = 100
"""Length of the paths, up to the end of the episode: longer ones hide each other."""
MAX_UAVS_IN_LEGEND = 10
"""Larger teams get no legend of their UAVs."""
Cells = NDArray[np.int64]


@style.own_settings()
def map_picture(road_map: RoadMap, path: Path, starts: Iterable[int] = ()) -> Path:
    """Draw roads, blocked cells and, where given, start cells; return `path`."""
    made, axes = _axes(road_map)
    codes = np.where(road_map.blocked, 2, road_map.road)
    colours = ListedColormap([style.LIGHT, style.ROAD, style.BLOCKED])
    _cells_image(axes, road_map, codes, cmap=colours, vmin=0, vmax=2)
    _grid_lines(axes, road_map)
    handles: list[Any] = [
        Patch(color=style.ROAD, label=f"road ({int(road_map.road.sum()):,} cells)"),
        Patch(color=style.BLOCKED, label=f"obstacle or no-fly ({int(road_map.blocked.sum()):,})"),
    ]
    if chosen := list(starts):
        axes.scatter(*_xy(road_map, np.array(chosen)), s=70, color=palette.VERMILION, edgecolor="white", zorder=3)
        handles.append(_marker("o", palette.VERMILION, f"start ({len(chosen)} UAVs)"))
    _legend(made, handles)
    size = f"{road_map.grid.rows} x {road_map.grid.cols} cells of {road_map.cell_m:g} m"
    axes.set_title(f"{style.name(road_map.name)}: {size}")
    return style.save(made, path)


@style.own_settings()
def paths_picture(world: World, episode: Episode, path: Path) -> Path:
    """Draw the paths of the last ticks over the map at the end of the episode, the newest strongest; return `path`."""
    made, axes = _axes(world.map)
    end = int(np.flatnonzero((episode.cells != UNKNOWN).any(axis=1))[-1])
    handles = _ground(made, axes, world, episode, end)
    cells = episode.cells[max(0, end - PATH_TICKS) : end + 1]
    there = np.flatnonzero((cells != UNKNOWN).any(axis=0))  # others were lost before, or were never there
    team = [_path(axes, world.map, cells[cells[:, i] != UNKNOWN, i], i, cells.shape[1]) for i in there.tolist()]
    handles += team if len(team) <= MAX_UAVS_IN_LEGEND else []
    handles += [_marker("o", "white", f"at tick {end - len(cells) + 1:,}", edge=style.GREY, size=6),
                _marker("o", style.GREY, f"at tick {end:,}")]  # fmt: skip
    _legend(made, handles)
    what = "active events" if world.config.scenario == 1 else "uncertainty"
    axes.set_title(f"Paths of episode {episode.number}, last {len(cells) - 1} ticks, and {what} at tick {end:,}")
    return style.save(made, path)


def values_at(world: World, episode: Episode, tick: int) -> NDArray[np.float64]:
    """Return u_k of the true map at a tick, NaN where a cell is not monitored; shape (K,).

    In scenario I, 1 where an event is active, otherwise 0.
    """
    track, cells = episode.cells[: tick + 1], world.law.cells
    last = np.zeros(world.grid.size, np.int64)
    for t, row in enumerate(track):
        last[row[row != UNKNOWN]] = t
    values = np.full(world.grid.size, np.nan)
    if world.config.scenario == 1:
        events = episode.events[episode.events[:, 0] <= tick]
        values[cells] = 0.0
        # An event appears after the visits of its tick.
        values[events[events[:, 0] >= last[events[:, 1]], 1]] = 1.0
    else:
        factor = world.initial_factor(episode.number)
        values[cells] = world.law.values(last[cells].astype(np.uint16), tick, factor)
    return values


def _ground(made: Figure, axes: Any, world: World, episode: Episode, end: int) -> list[Any]:
    """Draw the map under the paths; return the handles of its legend."""
    values, blocked = values_at(world, episode, end), world.map.blocked
    _cells_image(axes, world.map, np.where(blocked, 1.0, 0.0), cmap=ListedColormap([style.LIGHT, style.BLOCKED]))
    handles: list[Any] = [Patch(color=style.BLOCKED, label="obstacle or no-fly")] if blocked.any() else []
    if world.config.scenario == 1:
        _cells_image(axes, world.map, values, cmap=ListedColormap(["#C9C9C9", palette.YELLOW]), vmin=0, vmax=1)
        count = int(np.nansum(values))
        handles += [Patch(color="#C9C9C9", label="road"), Patch(color=palette.YELLOW, label=f"active event ({count})")]
    else:
        image = _cells_image(axes, world.map, values, cmap=style.UNCERTAINTY, vmin=0, vmax=1)
        made.colorbar(image, ax=axes, label="uncertainty per cell", shrink=0.7, pad=0.02)
    _grid_lines(axes, world.map)
    return handles


def _path(axes: Any, road_map: RoadMap, cells: Cells, uav: int, team: int) -> Line2D:
    """Draw one UAV's path, fading with age, shifted to lie beside those of other UAVs; return its legend's handle."""
    colour = palette.colour_of(uav)
    shape = style.UAV_MARKERS[palette.shape_of(uav) % len(style.UAV_MARKERS)]
    shift = (uav - (team - 1) / 2) / max(team, 4) * 0.6 * road_map.cell_m
    points = np.stack(_xy(road_map, cells), axis=1) + np.array([shift, -shift])
    age = np.linspace(0.25, 1.0, max(len(points) - 1, 0))
    pieces = list(np.stack((points[:-1], points[1:]), axis=1))
    if pieces:
        edge = LineCollection(pieces, colors="white", linewidths=1.2 + 2 * age, alpha=age * 0.9, zorder=3)
        axes.add_collection(edge)
        axes.add_collection(LineCollection(pieces, colors=colour, linewidths=0.6 + 1.4 * age, alpha=age, zorder=4))
    axes.scatter(*points[0], s=26, marker=shape, facecolor="white", edgecolor=colour, linewidth=1.4, zorder=5)
    axes.scatter(*points[-1], s=80, marker=shape, facecolor=colour, edgecolor="white", linewidth=1.2, zorder=6)
    return _marker(shape, colour, f"UAV {uav}")


def _axes(road_map: RoadMap) -> tuple[Figure, Any]:
    """Return a figure with axes in metres from the south-west corner, and a north arrow."""
    width, height = road_map.grid.cols * road_map.cell_m, road_map.grid.rows * road_map.cell_m
    made = style.figure(8.5, float(np.clip(7.0 * height / width + 1.0, 3.5, 10.0)))
    axes = made.add_subplot()
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    axes.set_xlabel("street-east (m)")
    axes.set_ylabel("street-north (m)")
    _north(axes)
    return made, axes


def _north(axes: Any) -> None:
    """Draw an arrow to the grid's north, along the streets, right of the map."""
    arrow = {"arrowstyle": "-|>", "color": palette.BLACK, "linewidth": 1.5, "shrinkB": 0}
    placing = {"xycoords": "axes fraction", "textcoords": "offset points", "ha": "center", "va": "top", "fontsize": 8}
    axes.annotate("street\nnorth", xy=(1.05, 1.0), xytext=(0, -32), arrowprops=arrow, **placing)


def _grid_lines(axes: Any, road_map: RoadMap) -> None:
    """Draw thin lines between cells where cells are large enough. Minor ticks would take half a second."""
    rows, cols, width = road_map.grid.rows, road_map.grid.cols, road_map.cell_m
    if max(rows, cols) <= 60:
        axes.vlines(np.arange(1, cols) * width, 0, rows * width, color="white", linewidth=0.5)
        axes.hlines(np.arange(1, rows) * width, 0, cols * width, color="white", linewidth=0.5)


def _cells_image(axes: Any, road_map: RoadMap, values: NDArray[Any], **how: Any) -> Any:
    """Draw values by cell, shape (K,), as an image in metres."""
    rows, cols = road_map.grid.rows, road_map.grid.cols
    extent = (0, cols * road_map.cell_m, 0, rows * road_map.cell_m)
    return axes.imshow(values.reshape(rows, cols), extent=extent, interpolation="nearest", **how)


def _xy(road_map: RoadMap, cells: Cells) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centres of cells, metres east and north of the south-west corner."""
    rows, cols = np.divmod(cells, road_map.grid.cols)
    return (cols + 0.5) * road_map.cell_m, (road_map.grid.rows - rows - 0.5) * road_map.cell_m


def _marker(shape: str, colour: str, label: str, edge: str = "white", size: float = 9) -> Line2D:
    return Line2D([], [], marker=shape, color=colour, markeredgecolor=edge, markersize=size, linestyle="", label=label)


def _legend(made: Figure, handles: Sequence[Any]) -> None:
    """Draw the legend below the map, so that it hides no cell."""
    made.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 7), frameon=False, fontsize=8)
