"""`overfly map ...`: lists, shows, exports and checks maps."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from deploy import extras
from tmc.analysis.report.pictures import PictureError, draw_map
from tmc.kernel.rastertext import COMMENT, raster_text
from tmc.kernel.roadmap import OBSTACLES, ROADS, MapError, RoadMap, builtin_maps, check, load_map
from tmc.kernel.text import printable

DEFAULT = "downtown-toronto"
ABOUT = {
    "list": "the maps that come with Overfly, and what their presets count",
    "show": "draw a map as text that --map takes, and as a picture with --out",
    "export": "the grid as CSV, one line per row from the north: 0 free, 1 road, 2 blocked; --map takes it",
    "check": "what to check before flying a map; exit code 1 if there are findings",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    views = parser.add_subparsers(dest="view", required=True, metavar="VIEW")
    for view, about in ABOUT.items():
        sub = views.add_parser(view, help=about, description=about)
        if view == "list":
            continue
        sub.add_argument("name", nargs="?", default=DEFAULT, metavar="NAME",
                         help="a built-in map, or the path of a text raster (default: %(default)s)")  # fmt: skip
        sub.add_argument("--roads", choices=ROADS, default="main", help="classes of street (default: %(default)s)")
        sub.add_argument("--obstacles", choices=OBSTACLES, default="static", help="default: %(default)s")
        if view == "show":
            sub.add_argument("--out", type=Path, metavar="FILE.png", help="also write a picture")


def main(args: argparse.Namespace) -> int:
    """Print one view; return the exit code. Raises MapError."""
    if args.view == "list":
        return _list()
    return _VIEWS[args.view](load_map(args.name, args.roads, args.obstacles), args)


def _list() -> int:
    print(f"{'map':<20}{'roads':<10}{'obstacles':<11}{'cells':>9}{'road':>7}{'blocked':>9}")
    for name in builtin_maps():
        for roads in ROADS:
            for obstacles in OBSTACLES:
                m = load_map(name, roads, obstacles)
                size = f"{m.grid.rows} x {m.grid.cols}"
                print(f"{name:<20}{roads:<10}{obstacles:<11}{size:>9}{m.road.sum():>7,}{m.blocked.sum():>9,}")
    print("the paper's mission flies over roads main, obstacles static; `overfly map show` draws it")
    return 0


def _show(road_map: RoadMap, args: argparse.Namespace) -> int:
    out: Path | None = args.out
    if out is not None and out.suffix.lower() != ".png":
        raise MapError(f"--out {out} is not a PNG: give a name that ends in .png")
    if out is not None and out.exists():
        raise MapError(f"{out} exists already: choose another --out, or remove it")
    if out is not None and (why := extras.lacking(extras.FIGURES)):
        raise MapError(why)
    print(drawing(road_map))
    if out is not None:
        _picture(road_map, out)
        print(printable(f"{COMMENT} picture: {out}"))
    return 0


def drawing(road_map: RoadMap) -> str:
    """Return the map as text that `--map` takes, street-north on top, then the legend; square if lines are short."""
    m, total = road_map, road_map.grid.size
    rows = m.text().splitlines()
    wide = [" ".join(row) for row in rows] if m.grid.cols <= 40 else rows
    road, blocked = int(m.road.sum()), int(m.blocked.sum())
    size = f"{m.grid.rows} x {m.grid.cols} cells of {m.cell_m:g} m, street-north on top"
    counts = (("#", "road", road), (".", "free", total - road - blocked), ("X", "obstacle or no-fly", blocked))
    legend = ", ".join(f"{sign} {what} {count:,} ({count / total:.0%})" for sign, what, count in counts)
    header = {"name": m.name, "cell_m": repr(float(m.cell_m)).removesuffix(".0")}
    header |= {"attribution": m.attribution} if m.attribution else {}
    return raster_text(header, wide, [size, legend]).removesuffix("\n")


def _picture(road_map: RoadMap, out: Path) -> None:
    try:
        draw_map(road_map, out, extras.broken)
    except PictureError as error:
        raise MapError(f"the picture {out} could not be made: {error}") from None


def _export(road_map: RoadMap, _args: argparse.Namespace) -> int:
    sys.stdout.write(road_map.csv())
    return 0


def _check(road_map: RoadMap, _args: argparse.Namespace) -> int:
    findings = check(road_map)
    print("\n".join(map(printable, findings or [f"{road_map.name} is fine"])))
    return 1 if findings else 0


_VIEWS: dict[str, Callable[[RoadMap, argparse.Namespace], int]] = {"show": _show, "export": _export, "check": _check}
