"""The road map: the built-in downtown against golden rasters, the raster rule, users' files, and every refusal."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmc.kernel.grid import Grid
from tmc.kernel.raster import Georeference, components, flood, thin, walk
from tmc.kernel.roadmap import (
    OBSTACLES,
    ROADS,
    UNREACHABLE,
    MapError,
    RoadMap,
    builtin_maps,
    check,
    load_map,
    parse_raster,
)

GOLDEN = Path(__file__).parents[2] / "golden"
TORONTO = "downtown-toronto"


@pytest.fixture(scope="module")
def toronto() -> RoadMap:
    return load_map(TORONTO)


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    text = files("tmc.kernel").joinpath("maps", f"{TORONTO}.json").read_text("utf-8")
    loaded: dict[str, Any] = json.loads(text)
    return loaded


# The built-in map


def test_raster_is_the_golden_one() -> None:
    assert load_map(TORONTO, "main", "none").text() == (GOLDEN / "downtown-toronto-main.txt").read_text("utf-8")


def test_export_is_the_golden_one(toronto: RoadMap) -> None:
    assert toronto.csv() == (GOLDEN / "downtown-toronto.csv").read_text("utf-8")


@pytest.mark.parametrize(("roads", "cells"), [("major", 276), ("main", 323), ("arterial", 381), ("all", 409)])
def test_presets_have_their_number_of_road_cells(roads: str, cells: int) -> None:
    assert load_map(TORONTO, roads).road.sum() == cells


@pytest.mark.parametrize(
    ("streets", "row", "col"),
    [
        (("King", "Yonge"), 24, 24),
        (("Queen", "Spadina"), 17, 0),
        (("Yonge", "Dundas"), 10, 24),
        (("College", "University"), 0, 13),
        (("Front", "Bay"), 29, 21),
    ],
)
def test_crossings_lie_where_the_city_has_them(toronto: RoadMap, streets: tuple[str, str], row: int, col: int) -> None:
    cell = toronto.grid.cell(row, col)
    assert toronto.road[cell]
    assert toronto.georeference is not None
    for name in streets:
        lonlat = np.array(next(s.lonlat for s in toronto.streets if s.name.startswith(name)))
        assert cell in toronto.georeference.street_cells(lonlat)


def test_obstacle_cells_follow_from_place_and_radius(toronto: RoadMap, document: dict[str, Any]) -> None:
    geo = toronto.georeference
    assert geo is not None
    row, col = np.divmod(np.arange(geo.grid.size), geo.grid.cols)
    centres = np.stack([(col + 0.5) * geo.cell_m, (geo.grid.rows - row - 0.5) * geo.cell_m], axis=1)
    free = ~load_map(TORONTO, "main", "none").road
    for obstacle in document["obstacles"] + document["event_day"]:
        offset = centres - geo.metres(np.array(obstacle["lonlat"]))
        near = np.hypot(offset[:, 0], offset[:, 1]) <= obstacle["radius_m"]
        near &= free | (obstacle["kind"] == "event_no_fly")
        assert np.flatnonzero(near).tolist() == [geo.grid.cell(r, c) for r, c in obstacle["cells"]]


@pytest.mark.parametrize(
    ("obstacles", "blocked", "road"), [("none", 0, 323), ("static", 21, 323), ("event-day", 84, 304)]
)
def test_obstacles_yield_to_roads_and_the_event_day_closes_them(obstacles: str, blocked: int, road: int) -> None:
    m = load_map(TORONTO, obstacles=obstacles)
    assert (m.blocked.sum(), m.road.sum()) == (blocked, road)


@pytest.mark.parametrize("roads", ROADS)
@pytest.mark.parametrize("obstacles", OBSTACLES)
def test_every_variant_holds_the_invariants(roads: str, obstacles: str) -> None:
    m = load_map(TORONTO, roads, obstacles)
    assert not (m.road & m.blocked).any()
    assert set(m.rates) == {"uniform", "volume", "blend"}
    for rate in m.rates.values():
        assert rate.shape == (900,)
        assert rate[m.road].mean() == pytest.approx(1.0, abs=1e-12)
        assert (rate[m.road] > 0).all()
        assert not rate[~m.road].any()


def test_rates_are_the_counts(toronto: RoadMap, document: dict[str, Any]) -> None:
    counted = np.array(document["rates"]["volume"], float).ravel()
    np.testing.assert_allclose(toronto.rates["volume"][toronto.road], counted[toronto.road], rtol=1e-5)
    assert np.isnan(counted[~load_map(TORONTO, "arterial", "none").road]).all()


def test_uncounted_cells_get_the_quiet_rate_of_the_file(document: dict[str, Any]) -> None:
    m = load_map(TORONTO, "all", "none")
    counted = np.array(document["rates"]["volume"], float).ravel()
    missing = m.road & np.isnan(counted)
    assert missing.sum() == 409 - 381 + 2  # the collectors, and a block of York St that was not counted
    ratio = m.rates["volume"][missing] / m.rates["volume"][m.grid.cell(0, 0)]
    np.testing.assert_allclose(ratio, document["rates"]["uncounted"]["volume"] / counted[0])


def test_georeference_round_trip(toronto: RoadMap) -> None:
    assert toronto.georeference is not None
    for cell in range(toronto.grid.size):
        lonlat = toronto.lonlat(cell)
        assert lonlat is not None
        assert toronto.georeference.cell_at(*lonlat) == cell
    assert toronto.lonlat(0) == pytest.approx((-79.399946, 43.657754), abs=1e-6)
    assert toronto.georeference.cell_at(-79.0, 43.0) is None


def test_window_corners_are_those_of_the_mapping(toronto: RoadMap, document: dict[str, Any]) -> None:
    assert toronto.georeference is not None
    corners = toronto.georeference.metres(np.array(document["window"]["corners_lonlat"]))
    np.testing.assert_allclose(corners, [[0, 0], [1800, 0], [1800, 1800], [0, 1800]], atol=0.1)


def test_the_default_map_is_in_good_order(toronto: RoadMap) -> None:
    assert check(toronto) == []
    assert toronto.attribution == "Contains information licensed under the Open Government Licence - Toronto."
    assert toronto.name == TORONTO
    assert TORONTO in builtin_maps()
    assert (toronto.cell_m, toronto.grid) == (60.0, Grid(30, 30))


def test_every_source_in_the_document_is_named(document: dict[str, Any]) -> None:
    used = {s for street in document["streets"] for s in street["sources"]}
    used |= {o["source"] for o in document["obstacles"] + document["event_day"]} | set(document["rates"]["sources"])
    assert used == set(document["sources"])


def test_fingerprint_tells_maps_apart_and_is_stable(toronto: RoadMap) -> None:
    variants = {load_map(TORONTO, roads, obstacles).fingerprint for roads in ROADS for obstacles in OBSTACLES}
    assert len(variants) == len(ROADS) * len(OBSTACLES)
    assert load_map(TORONTO).fingerprint == toronto.fingerprint
    assert re.fullmatch("[0-9a-f]{64}", toronto.fingerprint)
    assert parse_raster("##\n##\n").fingerprint != parse_raster("####\n").fingerprint
    assert parse_raster("#.\n", "a").fingerprint == parse_raster("name: b\ncell_m: 5\n#.").fingerprint


def test_arrays_cannot_be_written(toronto: RoadMap) -> None:
    for array in (toronto.road, toronto.blocked, toronto.rates["volume"], toronto.road_distance):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


# Distances, components, findings


def test_road_distance_goes_around_what_is_blocked() -> None:
    m = parse_raster("#X...\n.X.X.\n.XX..\n.....")
    far = UNREACHABLE
    assert m.road_distance.reshape(4, 5).tolist() == [
        [0, far, 7, 7, 7],
        [1, far, 6, far, 6],
        [2, far, far, 5, 6],
        [3, 3, 4, 5, 6],
    ]


def _slow_distance(m: RoadMap) -> list[list[int]]:
    """Relaxation until nothing changes: an independent, slow way to the same distances."""
    rows, cols = m.grid.rows, m.grid.cols
    d = [[0 if m.road[r * cols + c] else UNREACHABLE for c in range(cols)] for r in range(rows)]
    for _ in range(rows * cols):
        for r in range(rows):
            for c in range(cols):
                if not m.blocked[r * cols + c]:
                    near = [
                        d[i][j]
                        for i in range(max(r - 1, 0), min(r + 2, rows))
                        for j in range(max(c - 1, 0), min(c + 2, cols))
                    ]
                    d[r][c] = min(d[r][c], min(near) + 1)
    return d


def test_findings_name_what_is_wrong_and_where() -> None:
    assert any("2 components of 3, 2 cells" in f for f in check(parse_raster("###....##")))
    assert any("dead ends, (row, col): (0, 0), (0, 3)" in f for f in check(parse_raster("####\n....")))
    assert any("cut off, (row, col): (0, 0)" in f for f in check(parse_raster("#X...##\nXX...##")))
    assert any("100.0% of the cells are road" in f for f in check(parse_raster("###\n###")))
    assert any("and 1 more" in f for f in check(parse_raster("#.#.#.#.#.#")))
    assert check(parse_raster("####\n#..#\n#..#\n####\n....\n....")) == []


# A user's raster


cells = (
    st.integers(1, 12)
    .flatmap(lambda width: st.lists(st.text("#.X", min_size=width, max_size=width), min_size=1, max_size=12))
    .filter(lambda rows: any("#" in row for row in rows))
)


@given(cells)
def test_a_raster_comes_back_as_it_was(rows: list[str]) -> None:
    m = parse_raster("\n".join(rows))
    assert m.text().splitlines() == rows
    assert m.csv().splitlines() == [",".join(str(".#X".index(c)) for c in row) for row in rows]
    assert parse_raster(m.text()).fingerprint == m.fingerprint
    assert m.rates["uniform"].tolist() == m.road.tolist()


@given(cells)
def test_road_distance_is_the_shortest_way(rows: list[str]) -> None:
    m = parse_raster("\n".join(rows))
    assert m.road_distance.reshape(m.grid.rows, m.grid.cols).tolist() == _slow_distance(m)


@given(cells)
def test_components_part_the_road(rows: list[str]) -> None:
    m = parse_raster("\n".join(rows))
    pieces = components(m.grid, m.road)
    assert sorted(int(k) for p in pieces for k in p) == np.flatnonzero(m.road).tolist()
    for piece in pieces:
        start = np.zeros(m.grid.size, bool)
        start[piece[0]] = True
        assert np.flatnonzero(flood(m.grid, start, m.road) < UNREACHABLE).tolist() == piece.tolist()
    check(m)  # never fails


def test_a_file_with_a_header(tmp_path: Path) -> None:
    path = tmp_path / "old town.txt"
    path.write_bytes(b"\xef\xbb\xbfname: Old town\r\ncell_m: 25.5\r\nattribution: me\r\n\r\n##X\r\n#..\r\n\r\n")
    m = load_map(str(path))
    assert (m.name, m.cell_m, m.attribution, m.text()) == ("Old town", 25.5, "me", "##X\n#..\n")
    assert m.lonlat(0) is None
    assert m.streets == ()
    assert not load_map(str(path), obstacles="none").blocked.any()
    assert load_map(str(path), obstacles="event-day").blocked.sum() == 1


@given(cells, st.sampled_from([" ", ",", ", "]), st.booleans())
def test_cells_may_stand_apart_and_as_numbers(rows: list[str], between: str, numbers: bool) -> None:
    signs = str.maketrans(".#X", "012") if numbers else {}
    text = "\n".join(between.join(row.translate(signs)) for row in rows)
    assert parse_raster("// a note\n" + text + "\n\n// another: one\n").text().splitlines() == rows


@given(cells)
def test_the_source_of_a_map_is_the_map(rows: list[str]) -> None:
    header = "name: Town: the old one\ncell_m: 12.125\nattribution: me\n"
    m = parse_raster(header + "\n".join(rows), keep_blocked=False)
    again = parse_raster(m.source, "another")
    assert (again.name, again.cell_m, again.attribution) == ("Town: the old one", 12.125, "me")
    assert again.text().splitlines() == rows and again.source == m.source
    assert parse_raster("\n".join(rows), "village").source.startswith("name: village\n")


def test_a_name_is_one_line_of_plain_text(tmp_path: Path) -> None:
    assert parse_raster("name: \x1b[31mred\u202e\n#").name == "[31mred"
    path = tmp_path / "a\x1b[2Jb\n.txt"
    path.write_text("#\n")
    assert load_map(str(path)).name == "a [2Jb"
    with pytest.raises(MapError) as refusal:
        load_map(str(path) + "\n")
    assert "\x1b" not in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_file_without_a_header_is_called_after_itself(tmp_path: Path) -> None:
    path = tmp_path / "village.txt"
    path.write_text("#.\n")
    assert (load_map(str(path)).name, load_map(str(path)).cell_m) == ("village", 60.0)


def test_the_largest_map_and_one_row_more() -> None:
    assert parse_raster("#" + "\n." * 65_534).grid.size == 65_535
    with pytest.raises(MapError, match=r"65536 x 1 cells, over 65,535 of them: make the cells wider"):
        parse_raster("#" + "\n." * 65_535)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no raster row: write one line per row"),
        ("\n \n", "has no raster row: write one line per row"),
        ("name: nothing else\n", "has no raster row: write one line per row"),
        ("..X\n...\n", "has no road cell in its 2 rows: mark road cells with #"),
        ("name: a\n\n###\n##\n", "line 4 has 2 cells and the first row 3: give all rows the same length"),
        ("##\n\n##\n", "line 2 has 0 cells and the first row 2: give all rows the same length"),
        ("###\n#o#\n", r"line 2, column 2 is 'o': use # \(road\), . \(free\) or X \(blocked\)"),
        ("0,1\n1,3\n", "line 2, column 2 is '3': use #"),
        ("0,1\n1,,1\n", "line 2, column 2 is '': use #"),
        ("0,1\n1,1,\n", "line 2, column 3 is '': use #"),
        ("# #\n#  #\n", "line 2, column 2 is '': use #"),
        ("0,1\n1\n", "line 2 has 1 cells and the first row 2: give all rows the same length"),
        ("// only words\n", "has no raster row: write one line per row"),
        ("##\n//\n\n##\n", "line 3 has 0 cells and the first row 2: give all rows the same length"),
        ("##\nname: late\n", "line 2, column 1 is 'name:': use #"),
        ("metres: 60\n##\n", "line 1 has the unknown key 'metres': use name, cell_m, attribution"),
        ("// a note\n\ncell_m: wide\n##\n", "line 3: cell_m is 'wide': give"),
        ("cell_m: true\n##\n", "cell_m is 'true': give"),
        ("cell_m:\n##\n", "cell_m is '': give"),
        ("cell_m: -60\n##\n", "cell_m is '-60': give"),
        ("cell_m: 1e308\n##\n", "cell_m is '1e308': give .* from 0.01 to 100,000"),
        ("cell_m: 1e-300\n##\n", "cell_m is '1e-300': give"),
        ("cell_m: 1e999\n##\n", "cell_m is '1e999': give"),
        ("name: a\nname: b\n##\n", "line 2 repeats 'name': keep one"),
        ("cell_m: wide\n##\n", "line 1: cell_m is 'wide': give the width of a cell in metres, such as 60"),
        ("cell_m: 0\n##\n", "cell_m is '0': give"),
        ("cell_m: inf\n##\n", "cell_m is 'inf': give"),
        ("cell_m: nan\n##\n", "cell_m is 'nan': give"),
    ],
)
def test_a_bad_raster_is_refused_with_the_place_and_the_mend(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "city.txt"
    path.write_text(text)
    with pytest.raises(MapError, match=message) as refusal:
        load_map(str(path))
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@given(st.text(max_size=60))
def test_any_text_is_a_map_or_a_map_error(text: str) -> None:
    try:
        assert parse_raster(text).road.any()
    except MapError as error:
        assert len(str(error).splitlines()) == 1


def test_names_and_presets_that_do_not_exist() -> None:
    with pytest.raises(MapError, match="no map and no file is called 'atlantis': use downtown-toronto, or the path of"):
        load_map("atlantis")
    with pytest.raises(MapError, match="roads = 'footpaths' is not known: use one of major, main, arterial, all"):
        load_map(TORONTO, "footpaths")
    with pytest.raises(MapError, match="obstacles = 'kites' is not known: use one of none, static, event-day"):
        load_map(TORONTO, obstacles="kites")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"cannot be read .* give the path of a readable text file"):
        load_map(str(tmp_path))
    with pytest.raises(MapError, match="cannot be read"):
        load_map("a\0b")
    binary = tmp_path / "city.png"
    binary.write_bytes(b"#.\n\x89PNG")
    with pytest.raises(MapError, match="byte 4 is not UTF-8: save the raster as plain text"):
        load_map(str(binary))
    huge = tmp_path / "huge.txt"
    huge.write_text("#" * 300_000)
    with pytest.raises(MapError, match="is over 262,144 bytes, too much for 65,535 cells"):
        load_map(str(huge))


def test_a_map_refuses_arrays_that_disagree() -> None:
    grid, road, free = Grid(1, 2), np.array([True, False]), np.array([False, False])
    with pytest.raises(MapError, match="has cells that are road and blocked"):
        RoadMap("m", grid, 60.0, road, road)
    with pytest.raises(MapError, match="has no road cell"):
        RoadMap("m", grid, 60.0, free, free)
    with pytest.raises(MapError, match="has an array without one value per cell: give 2 in each"):
        RoadMap("m", grid, 60.0, road, free[:1])
    for width in (0, -1.0, 1e308, float("nan"), float("inf")):
        with pytest.raises(MapError, match=r"has cells of .* m: give a width from"):
            RoadMap("m", grid, width, road, free)


# The raster rule


points = st.lists(st.tuples(st.floats(-5, 15), st.floats(-5, 15)), min_size=2, max_size=6)


@given(points)
def test_a_street_is_a_thin_connected_path(vertices: list[tuple[float, float]]) -> None:
    full = walk(np.array(vertices))
    path = thin(full)
    assert path[0] == full[0]
    assert set(path) <= set(full)
    assert all(max(abs(a[0] - b[0]), abs(a[1] - b[1])) <= 1 for a, b in pairwise(path))


def test_thin_drops_corners() -> None:
    assert thin([(0, 0), (1, 0), (1, 1), (2, 1), (2, 2)]) == [(0, 0), (1, 1), (2, 2)]
    assert thin([(0, 0), (1, 0), (2, 0)]) == [(0, 0), (1, 0), (2, 0)]
    assert thin([]) == []


def test_street_cells_keep_to_the_window() -> None:
    geo = Georeference(Grid(2, 3), 10.0, (0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    assert geo.street_cells(np.array([[-25.0, 5.0], [55.0, 5.0]])) == [3, 4, 5]
    assert geo.street_cells(np.array([[5.0, 50.0], [5.0, 60.0]])) == []
