"""Pictures are made, show something, and show the right map."""

import struct
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from matplotlib.image import imread

from tmc.analysis.metrics import summarize
from tmc.analysis.report import figures
from tmc.analysis.report.map_figures import values_at
from tmc.analysis.report.pictures import PictureError, draw_map
from tmc.analysis.run_data import read
from tmc.kernel.roadmap import load_map, parse_raster
from tmc.record import queries
from tmc.record.errors import RecordError

SCENARIO_1 = {"scenario": 1, "team.controller": "planner:greedy", "training.episodes": 2, "world.alpha": 0.2}


def colours(path):
    """Distinct colours of a PNG of a sensible size."""
    width, height = struct.unpack(">II", path.read_bytes()[16:24])
    assert width >= 800 and height >= 400
    pixels = (imread(path)[..., :3] * 255).astype(np.int64) @ [1, 256, 65536]
    return len(np.unique(pixels))


def drawn(folder, tmp_path, **how):
    flown = read(folder)
    return {path.name: make() for path, make in figures.pictures(flown, summarize(flown), **how).items()}


@pytest.mark.parametrize("values", [{}, SCENARIO_1, {"team.size": 12, "world.initial_map": "random"}])
def test_a_fly_run_has_map_paths_and_uncertainty(fly, tmp_path, values):
    folder = fly(**values)
    found = drawn(folder, tmp_path)
    assert list(found) == ["map.png", "paths.png", "uncertainty.png"]
    assert all(p.parent == folder / "report" and colours(p) > 30 for p in found.values())


def test_a_training_run_has_curves_and_baselines_change_them(learned, tmp_path):
    found = drawn(learned, tmp_path)
    assert list(found) == ["map.png", "paths.png", "curves.png"]
    assert colours(found["curves.png"]) > 100
    flown, plain = read(learned), found["curves.png"].read_bytes()
    path = figures.curves_picture(flown, summarize(flown), tmp_path / "curves.png", {"planner:greedy": 0.3})
    assert path.read_bytes() != plain


def test_another_episode_has_other_paths(learned, tmp_path):
    flown = read(learned)
    one, two = (figures.paths_picture(flown.world, flown.episode(e), tmp_path / f"{e}.png") for e in (1, 2))
    assert one.read_bytes() != two.read_bytes()
    with pytest.raises(RecordError, match="nothing of episode 9: ask for one of 1 to 3"):
        drawn(learned, tmp_path, episode=9)


def test_the_ground_of_the_paths_is_the_true_map_at_that_tick(fly):
    for values in ({}, SCENARIO_1, {"world.initial_map": "random"}):
        folder = fly(**values)
        flown = read(folder)
        curve = dict(queries.uncertainty(folder, 1))
        for tick in (0, 1, 17, 60):
            assert np.nansum(values_at(flown.world, flown.episodes[0], tick)) == pytest.approx(curve[tick])


@pytest.mark.parametrize("raster", ["##\n##\n", "#" * 300 + "\n", "#\n" * 300])
def test_maps_of_any_shape_can_be_drawn(tmp_path, raster):
    figures.map_picture(parse_raster(raster), tmp_path / "deep" / "map.png", starts=[0])
    assert (tmp_path / "deep" / "map.png").stat().st_size > 5000


def test_the_builtin_map(tmp_path):
    assert colours(figures.map_picture(load_map("downtown-toronto"), tmp_path / "map.png")) > 30


def test_a_folder_that_cannot_be_is_said_in_a_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PictureError, match=r"exists|directory"):
        draw_map(load_map("downtown-toronto"), tmp_path / "file" / "map.png")


def test_pyplot_is_not_imported():
    code = "import sys, tmc.analysis.report.figures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
