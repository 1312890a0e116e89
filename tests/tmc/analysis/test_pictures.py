"""Pictures and the user's surroundings: no setting of matplotlib reaches them, and none that fails costs the result."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

import matplotlib
from matplotlib.text import Text

from deploy.cli import main
from tests.command import LINE
from tmc.analysis.metrics import summarize
from tmc.analysis.report import figures, pictures, style
from tmc.analysis.run_data import read
from tmc.kernel.roadmap import load_map

TASTE = """
text.usetex: True
font.family: no such font
axes.unicode_minus: False
axes.facecolor: black
savefig.format: pdf
savefig.bbox: tight
savefig.dpi: 10
figure.dpi: 10
figure.constrained_layout.use: True
lines.linewidth: 20
"""
MAPS = {
    "mathtext that is none": r"$\frac$",
    "mathtext": "$x_1$",
    "TeX": r"100 % & \_{#}",
    "an escape sequence": "\x1b[31mred",
    "a mark of direction": "\N{RIGHT-TO-LEFT OVERRIDE}abc",
    "glyphs that no font has": "\N{CJK UNIFIED IDEOGRAPH-4E2D}" * 9,
    "very long": "x" * 3000,
    "hidden from legends": "_x",
}


def test_the_users_settings_of_matplotlib_change_nothing(tmp_path: Path) -> None:
    """In the environment, in the current folder, in the folder of settings; good ones, bad ones and unreadable ones."""
    plain, taste, odd = (tmp_path / name for name in ("plain", "taste", "odd"))
    for folder in (plain, taste, odd):
        folder.mkdir()
    (taste / "matplotlibrc").write_text(TASTE)
    (odd / "matplotlibrc").write_bytes(b"font.family: \xff\xfe\x00\n")
    (taste / "stylelib").mkdir()
    (taste / "stylelib" / "mine.mplstyle").write_bytes(b"\xff")
    surroundings: list[tuple[Path, dict[str, str]]] = [
        (plain, {}),
        (plain, {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}),
        (taste, {"MPLBACKEND": "no such thing", "PYTHONWARNINGS": "error"}),
        (odd, {"MPLBACKEND": "TkAgg", "DISPLAY": ":77", "MATPLOTLIBRC": str(taste)}),
        (plain, {"MATPLOTLIBRC": str(odd / "matplotlibrc"), "MPLCONFIGDIR": str(taste)}),
        (plain, {"MPLCONFIGDIR": os.devnull, "HOME": "/nowhere"}),
    ]
    found = set()
    for number, (cwd, environment) in enumerate(surroundings):
        out = tmp_path / f"{number}.png"
        line, env = [*LINE, "map", "show", "--out", str(out)], {**os.environ, **environment}
        done = subprocess.run(line, cwd=cwd, env=env, capture_output=True, text=True, timeout=100, check=False)
        assert (done.returncode, done.stderr) == (0, ""), environment
        found.add(out.read_bytes())
    assert len(found) == 1


def test_a_mission_in_a_notebook_has_its_summary_and_its_pictures(tmp_path: Path) -> None:
    env = {**os.environ, "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    line = [*LINE, "fly", "planner:random", "--lockstep", "--ticks", "20", "--out", "R"]
    done = subprocess.run(line, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0 and "overfly:" not in done.stderr, done.stderr
    assert done.stdout.splitlines()[-1] == "Pictures   R/report/{map.png,paths.png,uncertainty.png}"


def test_what_the_program_has_set_is_not_used_and_not_changed(tmp_path: Path) -> None:
    town = load_map("downtown-toronto")
    plain = figures.map_picture(town, tmp_path / "plain.png").read_bytes()
    with matplotlib.rc_context({"text.usetex": True, "axes.facecolor": "black", "savefig.dpi": 10}):
        assert figures.map_picture(town, tmp_path / "ours.png").read_bytes() == plain
        assert matplotlib.rcParams["text.usetex"] is True
    assert matplotlib.rcParams["text.parse_math"] is True


@pytest.mark.parametrize("name", MAPS.values(), ids=MAPS)
def test_a_name_is_drawn_as_it_is_written(
    name: str, learned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Text] = []
    save = style.save
    monkeypatch.setattr(style, "save", lambda made, path: (drawn.extend(made.findobj(Text)), save(made, path))[1])
    flown = read(learned)
    summary = summarize(flown)
    summary = dataclasses.replace(summary, mission=dataclasses.replace(summary.mission, map=name, controller=name))
    road_map = dataclasses.replace(flown.world.map, name=name)
    figures.map_picture(road_map, tmp_path / "map.png")
    figures.curves_picture(flown, summary, tmp_path / "curves.png", {name: 0.3})
    figures.uncertainty_picture(flown, summary, flown.episodes[0], tmp_path / "uncertainty.png")
    with_it = [text for text in drawn if style.name(name).strip() in text.get_text()]
    assert len(with_it) == 4, "two titles, a title above four, and a legend"
    for text in with_it:
        assert text.get_text().isprintable() and not text.get_parse_math() and not text.get_usetex()


def test_a_picture_that_fails_costs_a_sentence(learned: Path, monkeypatch, capsys) -> None:
    def fail(*_: object) -> Path:
        raise RuntimeError("dvipng was not\nable to process $\\frac$\x1b[31m")

    monkeypatch.setattr(figures, "paths_picture", fail)
    assert main(["analyze", str(learned)]) == 0
    printed = capsys.readouterr()
    paths = learned / "report" / "paths.png"
    assert printed.err == (
        f"overfly: the picture {paths} could not be made: dvipng was not able to process $\\frac$\\x1b[31m\n"
    )  # fmt: skip
    assert printed.out.splitlines()[-1] == f"Pictures   {paths.parent}/{{curves.png,map.png}}"


def test_the_result_is_told_before_any_picture_is_tried(learned: Path, monkeypatch, capsys) -> None:
    """Were the process killed in a picture, all else is there."""

    def killed(*_: object) -> Path:
        assert "Uncertainty" in capsys.readouterr().out
        assert json.loads((learned / "summary.json").read_text())
        raise KeyboardInterrupt

    (learned / "summary.json").unlink(missing_ok=True)
    monkeypatch.setattr(figures, "map_picture", killed)
    assert main(["analyze", str(learned)]) == 130


def test_a_matplotlib_that_is_broken_costs_a_sentence(fly, capsys, monkeypatch) -> None:
    """Built for another NumPy, say."""

    load, run = pictures.importlib.import_module, fly()
    capsys.readouterr()

    def broken(name: str) -> object:
        if name == "tmc.analysis.report.figures":
            raise ImportError("numpy.core.multiarray failed to import")
        return load(name)

    monkeypatch.setattr(pictures.importlib, "import_module", broken)
    assert main(["analyze", str(run)]) == 0
    assert capsys.readouterr().err == "overfly: no pictures: numpy.core.multiarray failed to import\n"


def test_the_current_folder_and_the_environment_are_as_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "TkAgg")
    monkeypatch.delenv("MATPLOTLIBRC", raising=False)
    pictures.draw_map(load_map("downtown-toronto"), Path("map.png"))
    assert (tmp_path / "map.png").exists() and Path.cwd() == tmp_path
    assert os.environ["MPLBACKEND"] == "TkAgg" and "MATPLOTLIBRC" not in os.environ


def test_a_current_folder_that_is_gone_does_not_matter(tmp_path: Path) -> None:
    code = f"""
import os, pathlib, sys
os.mkdir("gone"); os.chdir("gone"); os.rmdir("../gone")
from tmc.analysis.report.pictures import draw_map
from tmc.kernel.roadmap import load_map
draw_map(load_map("downtown-toronto"), pathlib.Path({str(tmp_path / "map.png")!r}))
"""
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "map.png").exists()
