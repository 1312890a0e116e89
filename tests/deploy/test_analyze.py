"""`overfly analyze`: the summary on the screen or as JSON, the pictures, and mistakes in one sentence."""

import json
import subprocess
import sys

import pytest

from deploy.cli import main
from deploy.commands.analyze import report


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("analyze") / "r"
    assert main(["fly", "planner:greedy", "--lockstep", "--ticks", "60", "--episodes", "2", "--out", str(folder)]) == 0
    return folder


def test_text_summary_and_pictures(run, capsys):
    assert main(["analyze", str(run)]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) <= 24 and str(run) in out
    assert {p.name for p in (run / "report").iterdir()} == {"map.png", "paths.png", "uncertainty.png"}
    assert json.loads((run / "summary.json").read_text())["mission"]["episodes_flown"] == 2


def test_json_is_all_of_stdout_and_the_file(run, capsys):
    assert main(["analyze", str(run), "--json", "--no-pictures"]) == 0
    out = capsys.readouterr().out
    assert json.loads(out)["mission"]["controller"] == "planner:greedy"
    assert (run / "summary.json").read_text() == out


def test_an_episode_may_be_chosen(run, capsys):
    last = (run / "report" / "paths.png").read_bytes()  # flying made it
    assert main(["analyze", str(run), "--episode", "1"]) == 0
    assert (run / "report" / "paths.png").read_bytes() != last


def test_without_matplotlib_it_says_how_to_install_it_and_goes_on(run, capsys, monkeypatch):
    for name in [n for n in sys.modules if n.split(".")[0] == "matplotlib" or n == "tmc.analysis.report.figures"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr("tmc.analysis.report.figures", raising=False)
    monkeypatch.setattr(sys, "meta_path", [NoMatplotlib(), *sys.meta_path])
    assert report(run, as_json=False) == 0
    printed = capsys.readouterr()
    assert "no pictures: a picture needs matplotlib (not installed): run " in printed.err
    assert "-m pip install " in printed.err and len(printed.err.splitlines()) == 1
    assert "Pictures" not in printed.out and "Uncertainty" in printed.out


class NoMatplotlib:
    """Hide matplotlib by an import hook."""

    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "matplotlib":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--episode", "7"], "holds nothing of episode 7: ask for one of 1 to 2"),
        (["--baseline", "greedy"], "is not NAME=VALUE"),
        (["--baseline", "=0.3"], "is not NAME=VALUE"),
        (["--baseline", "greedy=low"], "is not NAME=VALUE"),
    ],
)
def test_mistakes_are_one_sentence(run, capsys, options, sentence):
    assert main(["analyze", str(run), *options]) == 2
    err = capsys.readouterr().err
    assert sentence in err and len(err.splitlines()) == 1


def test_no_run_folder(tmp_path, capsys):
    for path in (tmp_path, tmp_path / "nowhere", __file__):
        assert main(["analyze", str(path)]) == 2
        err = capsys.readouterr().err
        assert "give the folder of a run" in err and len(err.splitlines()) == 1


def test_a_run_without_flights(run, tmp_path, capsys):
    (tmp_path / "config.json").write_text((run / "config.json").read_text())
    data = (run / "tmc.mcap").read_bytes()
    (tmp_path / "tmc.mcap.active").write_bytes(data[:60])
    assert main(["analyze", str(tmp_path)]) == 2
    assert "holds no flight" in capsys.readouterr().err


def test_matplotlib_is_imported_only_for_pictures():
    code = "import sys, deploy.commands.analyze, deploy.commands.map; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_bound_of_0_is_not_compared_with(tmp_path, capsys):
    """Two UAVs on a map of two cells: no cell is ever unvisited."""
    (tmp_path / "two.txt").write_text("##\n")
    mission = ["--actors", "2", "--ticks", "20", "--map", str(tmp_path / "two.txt")]
    out = str(tmp_path / "R")
    assert main(["fly", "planner:greedy", *mission, "--lockstep", "--no-pictures", "--out", out]) == 0
    printed = capsys.readouterr().out
    assert next(line for line in printed.splitlines() if "episode 1 " in line).split()[-1] == "-"
    assert "lower bound" not in printed
    assert main(["evaluate", "planner:greedy", *mission, "--seeds", "2", "--jobs", "1"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].split()[-4] == "-"
