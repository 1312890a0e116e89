"""`overfly map`: list, show, export, check."""

from pathlib import Path

import pytest

from deploy.cli import main
from tmc.kernel.roadmap import load_map

GOLDEN = Path(__file__).parent.parent / "golden"


@pytest.fixture
def town(tmp_path):
    raster = tmp_path / "town.txt"
    raster.write_text("name: Old town\ncell_m: 20\n#####\n#.X.#\n#####\n")
    return str(raster)


def test_list_counts_every_preset(capsys):
    assert main(["map", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[5].split() == ["downtown-toronto", "main", "static", "30", "x", "30", "323", "21"]
    assert len(lines) == 1 + 4 * 3 + 1


def test_export_is_the_golden_grid_and_nothing_else(capsys):
    assert main(["map", "export"]) == 0
    assert capsys.readouterr() == ((GOLDEN / "downtown-toronto.csv").read_text(), "")


def test_export_follows_the_options(town, capsys):
    assert main(["map", "export", "downtown-toronto", "--roads", "all", "--obstacles", "event-day"]) == 0
    assert capsys.readouterr().out == load_map("downtown-toronto", "all", "event-day").csv()
    assert main(["map", "export", town]) == 0
    assert capsys.readouterr().out == "1,1,1,1,1\n1,0,2,0,1\n1,1,1,1,1\n"


def test_show_draws_the_map_with_legend_and_counts(town, capsys):
    assert main(["map", "show", town]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[:3] == ["# # # # #", "# . X . #", "# # # # #"]
    assert out[4] == "Old town: 3 x 5 cells of 20 m, street-north on top"
    assert out[5] == "# road 12 (80%), . free 2 (13%), X obstacle or no-fly 1 (7%)"


def test_show_of_the_builtin_map_is_its_golden_text(capsys):
    assert main(["map", "show", "--obstacles", "none"]) == 0
    drawn = capsys.readouterr().out.replace(" ", "").splitlines()[:30]
    assert drawn == (GOLDEN / "downtown-toronto-main.txt").read_text().splitlines()


def test_a_wide_map_is_not_spaced(tmp_path, capsys):
    (tmp_path / "wide.txt").write_text("#" * 41 + "\n")
    assert main(["map", "show", str(tmp_path / "wide.txt")]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "#" * 41


def test_show_writes_a_picture(town, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    out = tmp_path / "town.png"
    assert main(["map", "show", town, "--out", str(out)]) == 0
    assert out.read_bytes().startswith(b"\x89PNG") and str(out) in capsys.readouterr().out


def test_check_is_quiet_about_a_map_in_order_and_says_what_is_not(tmp_path, capsys):
    assert main(["map", "check"]) == 0
    assert capsys.readouterr().out == "downtown-toronto is fine\n"
    (tmp_path / "apart.txt").write_text("##..##\n......\n##..##\n")
    assert main(["map", "check", str(tmp_path / "apart.txt")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and "4 components" in lines[0] and "dead ends" in lines[1]


def test_mistakes_are_one_sentence(town, tmp_path, capsys):
    blocked = tmp_path / "file"
    blocked.write_text("")
    for argv in (["show", "nowhere"], ["check", str(tmp_path)], ["show", town, "--out", "town.jpg"],
                 ["show", town, "--out", str(blocked / "town.png")]):  # fmt: skip
        assert main(["map", *argv]) == 2
        err = capsys.readouterr().err
        assert err.startswith("overfly: ") and len(err.splitlines()) == 1
    for argv in ([], ["draw"], ["show", "--roads", "tiny"]):
        with pytest.raises(SystemExit) as stop:
            main(["map", *argv])
        assert stop.value.code == 2
