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
    assert out[:3] == ["name: Old town", "cell_m: 20", ""]
    assert out[3:6] == ["# # # # #", "# . X . #", "# # # # #"]
    assert out[7] == "// 3 x 5 cells of 20 m, street-north on top"
    assert out[8] == "// # road 12 (80%), . free 2 (13%), X obstacle or no-fly 1 (7%)"


def test_show_of_the_builtin_map_is_its_golden_text(capsys):
    assert main(["map", "show", "--obstacles", "none"]) == 0
    drawn = capsys.readouterr().out.replace(" ", "").splitlines()
    assert [line for line in drawn if set(line) and set(line) <= set("#.X")] == (
        GOLDEN / "downtown-toronto-main.txt"
    ).read_text().splitlines()


def test_a_wide_map_is_not_spaced(tmp_path, capsys):
    (tmp_path / "wide.txt").write_text("#" * 41 + "\n")
    assert main(["map", "show", str(tmp_path / "wide.txt")]) == 0
    assert "#" * 41 in capsys.readouterr().out.splitlines()


TOWN = "name: Old town\ncell_m: 20.25\nattribution: me: and you\n#####\n#.X.#\n#####\n"
WIDE = "#" * 41 + "\n" + "." * 20 + "X" * 21 + "\n"


MAPS = {"town": TOWN, "wide": WIDE, "column": "#\n.\nX\n", "cell": "#\n", "built-in": None}
CHANGES = {
    "as it is": str,
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "BOM": lambda text: "\ufeff" + text,
    "blank lines": lambda text: text + "\n \n\n",
}


@pytest.mark.parametrize("text", MAPS.values(), ids=MAPS)
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_what_show_and_export_write_can_be_read(text, change, tmp_path, capsys):
    if text is not None:
        (tmp_path / "map.txt").write_text(text)
    name = "downtown-toronto" if text is None else str(tmp_path / "map.txt")
    was = load_map(name)
    for view in ("show", "export"):
        assert main(["map", view, name]) == 0
        (tmp_path / view).write_bytes(change(capsys.readouterr().out).encode())
        read = load_map(str(tmp_path / view))
        assert (read.text(), read.fingerprint) == (was.text(), was.fingerprint)
        if view == "show":
            assert (read.name, read.cell_m, read.attribution) == (was.name, was.cell_m, was.attribution)


def test_what_show_writes_can_be_read_with_the_line_of_a_picture(town, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    assert main(["map", "show", town, "--out", str(tmp_path / "town.png")]) == 0
    (tmp_path / "shown").write_text(capsys.readouterr().out)
    assert load_map(str(tmp_path / "shown")).fingerprint == load_map(town).fingerprint


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
