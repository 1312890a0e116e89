"""The road map (Sec. II): which cells are road, which are blocked, and the event rate of each.

The kernel reads no files but the built-in maps (`maps/*.json`, package data) and a user's text raster.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tmc.kernel import files as regular
from tmc.kernel.grid import OFF_GRID, STAY, Grid
from tmc.kernel.raster import UNREACHABLE, Georeference, components, flood
from tmc.kernel.rastertext import BLOCKED, CELL_M, FREE, ROAD, MapError, parse_text, raster_text
from tmc.kernel.text import nearest

__all__ = [
    "MAP_COPY",
    "OBSTACLES",
    "ROADS",
    "UNREACHABLE",
    "MapError",
    "RoadMap",
    "Street",
    "builtin_maps",
    "check",
    "load_map",
    "map_of_run",
    "parse_raster",
]

ROADS = ("major", "main", "arterial", "all")
OBSTACLES = ("none", "static", "event-day")
DEFAULT_CELL_M = 60.0
"""Width of a cell, metres, of a text raster without one: that of the built-in map."""
MAP_COPY = "map.txt"
"""Name of the copy of a user's map in the run folder. With it, the folder is enough to resume the run elsewhere."""
Scalar = TypeVar("Scalar", bound=np.generic)
MAX_RASTER_BYTES = 2**18  # 65,535 one-cell rows with CRLF have 196,605 bytes; the rest is room for a header


@dataclass(frozen=True)
class Street:
    """A street of a built-in map. `lonlat`: its vertices, (lon, lat) in degrees."""

    name: str
    road_class: str
    lonlat: tuple[tuple[float, float], ...]


@dataclass(frozen=True, eq=False)
class RoadMap:
    """A grid of square cells, each road, free or blocked. Arrays are read-only.

    `road`, `blocked`: shape (K,), bool. `blocked`: static obstacles and no-fly cells. `cell_m`: width, metres.
    `rates`: {name: shape (K,)}, relative, mean 1 over the road cells and 0 elsewhere; "uniform" always exists.
    `streets`: those that are road in this preset; empty for a user's raster.
    `source`: the complete text of a user's raster, with its name; empty for a built-in map.

    Raises MapError when the arrays disagree.
    """

    name: str
    grid: Grid
    cell_m: float
    road: NDArray[np.bool_]
    blocked: NDArray[np.bool_]
    rates: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    streets: tuple[Street, ...] = ()
    attribution: str = ""
    georeference: Georeference | None = None
    source: str = ""

    def __post_init__(self) -> None:
        rates = {"uniform": self.road.astype(np.float64), **self.rates}
        if any(a.shape != (self.grid.size,) for a in (self.road, self.blocked, *rates.values())):
            raise MapError(f"map '{self.name}' has an array without one value per cell: give {self.grid.size} in each")
        if not self.road.any():
            raise MapError(f"map '{self.name}' has no road cell, so there is nothing to patrol: mark some as road")
        if (self.road & self.blocked).any():
            raise MapError(f"map '{self.name}' has cells that are road and blocked: choose one for each")
        if not CELL_M[0] <= self.cell_m <= CELL_M[1]:
            fix = f"give a width from {CELL_M[0]:g} to {CELL_M[1]:,.0f}"
            raise MapError(f"map '{self.name}' has cells of {self.cell_m:g} m: {fix}")
        object.__setattr__(self, "road", _frozen(self.road))
        object.__setattr__(self, "blocked", _frozen(self.blocked))
        object.__setattr__(self, "rates", {name: _frozen(rate) for name, rate in rates.items()})

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 (hex) of the grid, road and blocked cells: processes with the same one use the same map."""
        shape = f"{self.grid.rows}x{self.grid.cols}:".encode()
        return hashlib.sha256(shape + self._codes.tobytes()).hexdigest()

    @cached_property
    def road_distance(self) -> NDArray[np.int32]:
        """Moves to the nearest road cell around blocked cells; shape (K,), int32.

        0 on road; UNREACHABLE (2^30) on blocked cells and where there is no way.
        """
        return _frozen(flood(self.grid, self.road, ~self.blocked))

    @cached_property
    def _codes(self) -> NDArray[np.uint8]:
        """0 free, 1 road, 2 blocked; shape (K,), uint8."""
        return np.where(self.blocked, 2, self.road).astype(np.uint8)

    def lonlat(self, cell: int) -> tuple[float, float] | None:
        """Return (lon, lat) of the centre of `cell`, degrees; None where the map has no georeference."""
        return None if self.georeference is None else self.georeference.lonlat(cell)

    def csv(self) -> str:
        """Return one line per row from the north: comma separated, 0 free, 1 road, 2 blocked; no header."""
        return "".join(",".join(str(c) for c in row) + "\n" for row in self._rows())

    def text(self) -> str:
        """Return the raster that `load_map` reads, without a header: one line per row from the north."""
        return "".join("".join((FREE, ROAD, BLOCKED)[c] for c in row) + "\n" for row in self._rows())

    def _rows(self) -> list[list[int]]:
        rows: list[list[int]] = self._codes.reshape(self.grid.rows, self.grid.cols).tolist()
        return rows


def _frozen(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a read-only copy, since maps are shared."""
    copy = array.copy()
    copy.setflags(write=False)
    return copy


def builtin_maps() -> tuple[str, ...]:
    """Return the names of the maps that ship with Overfly."""
    folder = files("tmc.kernel").joinpath("maps")
    return tuple(sorted(f.name.removesuffix(".json") for f in folder.iterdir() if f.name.endswith(".json")))


def load_map(name: str, roads: str = "main", obstacles: str = "static") -> RoadMap:
    """Return the built-in map `name`, or the text raster at that path.

    `roads`: the classes that are road: "major", "main" (major, plus Front and Church, which close the perimeter),
    "arterial" or "all" (with collectors); a text raster has no classes, so all its roads count. `obstacles`: "none",
    "static", or "event-day" (static, plus the event-day no-fly cells); a text raster keeps its X unless "none".
    Where both apply, a cell is road, not a static obstacle; event-day cells are closed even on road. Raises MapError.
    """
    _choice("roads", roads, ROADS)
    _choice("obstacles", obstacles, OBSTACLES)
    if name in builtin_maps():
        source = files("tmc.kernel").joinpath("maps", f"{name}.json")
        return _from_document(json.loads(source.read_text("utf-8")), roads, obstacles)
    return parse_raster(_read(name), Path(name).stem, name, keep_blocked=obstacles != "none")


def map_of_run(folder: Path, name: str, roads: str, obstacles: str) -> RoadMap:
    """Return the map of a run in `folder`, as `load_map` does. The folder's copy of a user's map takes precedence."""
    copy = folder / MAP_COPY
    own = name not in builtin_maps() and copy.exists()
    return load_map(str(copy) if own else name, roads, obstacles)


def _choice(setting: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise MapError(f"{setting} = '{value}' is not known: use one of {', '.join(known)}")


def _read(path: str) -> str:
    shown = regular.plain(path)
    try:
        raw = regular.read_bytes(path, MAX_RASTER_BYTES + 1)
        text = raw.decode("utf-8-sig")
    except FileNotFoundError:
        near = nearest(path, builtin_maps())
        fix = f"did you mean {near}?" if near else f"use {', '.join(builtin_maps())}, or the path of a text raster"
        raise MapError(f"no map and no file is called '{shown}': {fix}") from None
    except UnicodeDecodeError as error:
        raise MapError(f"{shown}: byte {error.start + 1} is not UTF-8: save the raster as plain text") from None
    except (OSError, ValueError) as error:  # a folder, a pipe, no permission, an impossible name
        reason = getattr(error, "strerror", None) or error
        raise MapError(f"'{shown}' cannot be read ({reason}): give the path of a readable text file") from None
    if len(raw) > MAX_RASTER_BYTES:
        raise MapError(f"{shown} is over {MAX_RASTER_BYTES:,} bytes, too much for 65,535 cells: make the cells wider")
    return text


def parse_raster(text: str, name: str = "raster", where: str = "raster", *, keep_blocked: bool = True) -> RoadMap:
    """Return the map of a raster's text, in the form of `parse_text`. Raises MapError.

    `name`: used when the header has none. `where`: the name of the text in errors.
    """
    where = regular.plain(where)
    header, rows = parse_text(text, where)
    header = {"name": "", **header}
    header["name"] = header["name"] or regular.plain(name) or "raster"
    cells = np.array([list(row) for row in rows]).ravel()
    if not (cells == ROAD).any():
        raise MapError(f"{where} has no road cell in its {len(rows)} rows: mark road cells with #")
    return RoadMap(
        name=header["name"],
        grid=Grid(len(rows), len(rows[0])),
        cell_m=float(header.get("cell_m", DEFAULT_CELL_M)),
        road=cells == ROAD,
        blocked=(cells == BLOCKED) & keep_blocked,
        attribution=header.get("attribution", ""),
        source=raster_text(header, rows),
    )


def _from_document(doc: dict[str, Any], roads: str, obstacles: str) -> RoadMap:
    """Return the map of a document of `maps/`. These ship with the package and are tested, so nothing is checked."""
    grid = Grid(doc["rows"], doc["cols"])
    mapping = doc["mapping"]
    origin = tuple(doc["window"]["origin_lonlat"])
    geo = Georeference(grid, doc["cell_m"], origin, tuple(mapping["x"]), tuple(mapping["y"]))
    preset = doc["presets"][roads]
    chosen = [s for s in doc["streets"] if s["class"] in preset["classes"] or s["id"] in preset["streets"]]
    road = np.zeros(grid.size, np.bool_)
    for street in chosen:
        road[geo.street_cells(np.array(street["lonlat"]))] = True
    blocked = _cells(grid, doc["obstacles"] if obstacles != "none" else []) & ~road
    closed = _cells(grid, doc["event_day"] if obstacles == "event-day" else [])
    road &= ~closed
    return RoadMap(
        name=doc["name"],
        grid=grid,
        cell_m=doc["cell_m"],
        road=road,
        blocked=blocked | closed,
        rates={rate: _rate(doc["rates"], rate, road) for rate in doc["rates"]["uncounted"]},
        streets=tuple(Street(s["name"], s["class"], tuple((x, y) for x, y in s["lonlat"])) for s in chosen),
        attribution=doc["attribution"],
        georeference=geo,
    )


def _cells(grid: Grid, obstacles: list[dict[str, Any]]) -> NDArray[np.bool_]:
    mask = np.zeros(grid.size, np.bool_)
    mask[[grid.cell(row, col) for obstacle in obstacles for row, col in obstacle["cells"]]] = True
    return mask


def _rate(rates: dict[str, Any], name: str, road: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return rates with mean 1 over the road cells of this preset, 0 elsewhere; shape (K,).

    A road cell without a traffic count (collectors, a block of York St) gets the file's `uncounted` value, the lower
    quartile of minor arterials. So every road cell has events.
    """
    table = np.array(rates[name], np.float64).ravel()  # null becomes NaN
    values = np.where(np.isnan(table), rates["uncounted"][name], table) * road
    return np.asarray(values / values[road].mean())


def check(road_map: RoadMap) -> list[str]:
    """Return what is unusual about a map, one sentence each; empty when nothing is.

    Reports several road components, dead ends, road cells that cannot be reached from the largest component of open
    cells, and a share of road below 2 % or above 60 % (a wrong cell size, or dual carriageways two cells wide).
    """
    grid, road = road_map.grid, road_map.road
    findings = []
    pieces = components(grid, road)
    if len(pieces) > 1:
        sizes = ", ".join(str(p.size) for p in pieces[:5]) + (", ..." if len(pieces) > 5 else "")
        findings.append(f"the road has {len(pieces)} components of {sizes} cells: join them, or keep the largest")
    if ends := _listed(grid, np.flatnonzero(road & (_road_neighbours(grid, road) < 2))):
        findings.append(f"road cells that are dead ends, (row, col): {ends}")
    apart = road.copy()
    apart[components(grid, ~road_map.blocked)[0]] = False
    if cut_off := _listed(grid, np.flatnonzero(apart)):
        findings.append(f"road cells that blocked cells cut off, (row, col): {cut_off}")
    share = float(road.mean())
    if not 0.02 <= share <= 0.6:
        findings.append(f"{share:.1%} of the cells are road, where 2 % to 60 % is usual: check the cell size")
    return findings


def _road_neighbours(grid: Grid, road: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return how many of the 8 neighbours of each cell are road; shape (K,), int64."""
    targets = grid.targets[:, :STAY]
    return np.asarray((road[targets] & (targets != OFF_GRID)).sum(axis=1))


def _listed(grid: Grid, cells: NDArray[np.int64]) -> str:
    """Return the first five cells as "(row, col)", and the number of the others."""
    shown = ", ".join(f"({k // grid.cols}, {k % grid.cols})" for k in cells[:5].tolist())
    return shown + (f" and {cells.size - 5} more" if cells.size > 5 else "")
