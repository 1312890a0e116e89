"""`overfly verify` finds no difference where there is none, and otherwise names the first by fact, tick and UAV."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from actors.airspace import Airspace
from deploy.cli import main
from deploy.verify import asynchrony, exactness
from tmc.kernel.config import JournalConfig, build
from tmc.kernel.grid import Grid
from tmc.kernel.rastertext import parse_text
from tmc.record import compare
from tmc.record.overfly_pb2 import UavStatus
from tmc.record.reader import read
from tmc.record.writer import LogWriter

TOWN = "\n".join(["#######", "#..X..#", "#.###.#", "#.#X#.#", "#######", ""])


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """A small map, where UAVs meet all the time."""
    path = tmp_path / "town.txt"
    path.write_text(TOWN)
    return path


def test_small_missions_under_stalls_show_no_difference(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--actors", "1,2,3", "--ticks", "60", "--scenarios", "2", "--tu", "7", "--stalls"]
    assert main(["verify", "exactness", *options]) == 0
    out, err = capsys.readouterr()
    rows = [line.split() for line in out.splitlines()[1:] if line.endswith("no difference")][:-1]
    assert [row[:6] for row in rows] == [
        ["1", "2", "7", "together", "1", "60"],  # a single UAV cannot be staggered
        ["2", "2", "7", "together", "1", "120"],
        ["2", "2", "7", "staggered", "1", "120"],
        ["3", "2", "7", "together", "1", "180"],
        ["3", "2", "7", "staggered", "1", "180"],
    ]
    assert re.fullmatch(r"5 missions, 660 steps, [\d,]+ facts in 0:\d\d: no difference", out.splitlines()[-1])
    assert err.startswith("mission 1 of 5\n")


def test_json_is_a_line_per_mission(capsys: pytest.CaptureFixture[str], town: Path) -> None:
    options = ["--actors", "3", "--ticks", "20", "--scenarios", "1", "--map", str(town), "--json"]
    assert main(["verify", "exactness", *options]) == 0
    (row,) = map(json.loads, capsys.readouterr().out.splitlines())
    assert (row["actors"], row["scenario"], row["tu"], row["steps"], row["difference"]) == (3, 1, 1, 60, None)
    assert row["facts"] > 5 * row["steps"]


def test_lock_step_with_blind_uavs_is_caught(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, town: Path, tmp_path: Path
) -> None:
    """A mistake in the airspace of one side alone: the first fact that follows from it is named."""
    monkeypatch.setattr(Airspace, "sense", lambda *_: [])
    out = tmp_path / "kept"
    options = ["--actors", "4", "--ticks", "30", "--scenarios", "2", "--tu", "5", "--phases", "together"]
    assert main(["verify", "exactness", *options, "--map", str(town), "--out", str(out)]) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines()[-1].endswith("DIFFERENT")
    assert re.search(r"different: sightings of UAV \d at tick \d+ of episode 1: \(.*\) against nothing", printed.err)
    (kept,) = out.iterdir()
    assert kept.name == "n4-scenario2-tu5-together-seed1" and str(kept) in printed.err
    assert (kept / "processes" / "tmc.mcap").is_file() and (kept / "lockstep" / "uav-003.mcap").is_file()


def test_one_altered_record_is_caught(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fly = exactness.fly

    def fly_and_alter(world: Any, policy: Any, out: Path, *, in_one_process: bool) -> None:
        fly(world, policy, out, in_one_process=in_one_process)
        if not in_one_process:
            alter(out / "tmc.mcap")

    monkeypatch.setattr(exactness, "fly", fly_and_alter)
    options = ["--actors", "2", "--ticks", "40", "--scenarios", "2", "--tu", "10", "--phases", "staggered"]
    assert main(["verify", "exactness", *options, "--out", str(tmp_path / "kept"), "--json"]) == 1
    printed = capsys.readouterr()
    difference = json.loads(printed.out)["difference"]
    assert (difference["what"], difference["tick"], difference["uav"]) == ("own reward", 23, 1)
    assert "different: own reward of UAV 1 at tick 23 of episode 1" in printed.err


def alter(path: Path) -> None:
    """Add a little to the reward of UAV 1 at tick 23."""
    entries = list(read(path))
    path.unlink()
    with LogWriter(path, "tmc", JournalConfig(), {}) as log:
        for entry in entries:
            m = entry.message
            if entry.topic == "/uav/1/record" and m.first <= 23 <= m.tick:
                m.rewards[23 - m.first] += 0.001
            log.write(entry.topic, m)


def test_nothing_is_left_behind_when_all_checks_pass(tmp_path: Path) -> None:
    out = tmp_path / "none"
    options = ["--actors", "1", "--ticks", "10", "--scenarios", "2", "--tu", "5"]
    assert main(["verify", "exactness", *options, "--out", str(out)]) == 0
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--actors", "1,x"), "'x' is not valid; list numbers"),
        (("--scenarios", "3"), "scenario = 3 is out of range"),
        (("--phases", "never"), "list together, staggered"),
        (("--tu", ""), "'' is not valid; list numbers"),
        (("--seeds", "0"), "--seeds must be 1 or more"),
        (("--actors", "400"), "team.size = 400 is larger"),
        (("--who", "planner:genius"), "there is no planner"),
        (("--set", "dqn.gama=1"), "there is no setting 'dqn.gama'"),
    ],
)
def test_mistakes_are_one_sentence(
    capsys: pytest.CaptureFixture[str], options: tuple[str, ...], text: str
) -> None:  # fmt: skip
    assert main(["verify", "exactness", *options]) == 2
    err = capsys.readouterr().err
    assert text in err and err.count("\n") == 1


@pytest.mark.parametrize("options", [("--actors", "1"), ("--hold", "0"), ("--actors", "5000")])
def test_mistakes_of_asynchrony_are_one_sentence(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, options: tuple[str, ...]
) -> None:  # fmt: skip
    assert main(["verify", "asynchrony", *options, "--out", str(tmp_path / "none")]) == 2
    assert "overfly: " in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_every_schedule_of_exchanges_is_flown_once() -> None:
    base = {"training.ticks": 9, "training.seed": 4}
    found = exactness.combinations(base, [1, 3], [1, 2], [1, 5], ["together", "staggered"], 2)
    kinds = [(c.team.size, c.scenario, c.T_u, c.comms.phase, c.training.seed) for c in found]
    assert kinds == [
        (n, scenario, period, phase, seed)
        for n, scenario, period, phase in [
            (1, 1, 1, "together"), (1, 2, 1, "together"), (1, 2, 5, "together"),
            (3, 1, 1, "together"), (3, 2, 1, "together"), (3, 2, 5, "together"), (3, 2, 5, "staggered"),
        ]
        for seed in (4, 5)
    ]  # fmt: skip
    assert next(share for _, _, share in exactness.with_progress(found)) == 0.0


# Asynchrony.


@pytest.mark.parametrize("team", [2, 3, 10, 60])
@pytest.mark.parametrize("apart", [True, False])
def test_the_delayed_uav_starts_alone_or_among_the_others(tmp_path: Path, team: int, apart: bool) -> None:
    raster = asynchrony.raster(team, apart=apart)
    rows = parse_text(raster, "here")[1]
    assert len(rows) == len(rows[0]) == asynchrony.SIDE_CELLS
    path = tmp_path / "corners.txt"
    path.write_text(raster)
    trial = asynchrony.Trial("", apart=apart, period=10, ticks=20)
    config, delayed_uav = asynchrony.config_of(trial, team, 0.1, {"team.controller": "planner:greedy"}, path)
    assert (config.trial.stall, config.trial.stall_uav) == (0.1, delayed_uav)
    starts = exactness.check(config).starts(1)
    chebyshev = Grid(asynchrony.SIDE_CELLS, asynchrony.SIDE_CELLS).chebyshev
    away = [chebyshev(starts[delayed_uav], cell) for i, cell in enumerate(starts) if i != delayed_uav]
    assert min(away) > 95 if apart else max(away) < 15


QUICK = {"team.controller": "planner:greedy", "training.episodes": 1}


@pytest.mark.parametrize(
    ("trial", "bound", "least"),
    [
        (asynchrony.Trial("far", apart=True, period=1000, ticks=60), "distance", 28),
        (asynchrony.Trial("far", apart=True, period=15, ticks=20), "exchange", 13),
        (asynchrony.Trial("far", apart=True, period=1000, ticks=20), "end", 17),
        (asynchrony.Trial("near", apart=False, period=1000, ticks=20), "distance", 1),
    ],
)
def test_what_bounds_the_lead(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, trial: asynchrony.Trial, bound: str, least: int
) -> None:
    monkeypatch.setattr(asynchrony, "SIDE_CELLS", 40)
    result = asynchrony.fly(trial, 3, 0.05, QUICK, None, tmp_path / "flight")
    assert result.passed, result.row()
    assert result.lead.bound == bound and result.lead.ticks >= least
    assert result.lead.ticks <= max(result.lead.cells, 1)
    assert not (tmp_path / "flight").exists()


def test_a_lead_that_no_rule_allows_is_seen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two UAVs side by side, one of which logs a lead of 5 ticks."""
    config = build({"team.size": 2, "world.map": "none"})
    facts = {(1, t, compare.KINDS.index("cell"), i): 10 + i for t in range(10) for i in range(2)}
    status = UavStatus(lead_most=5, lead_tick=7, lead_bound="distance")
    monkeypatch.setattr(asynchrony, "run_files", lambda _: {"uav-001": tmp_path})
    log = SimpleNamespace(messages=lambda _kind: iter([status]))
    monkeypatch.setattr(asynchrony, "Log", lambda _file: log)
    lead = asynchrony.farthest(config, facts, tmp_path, 0)
    assert (lead.ticks, lead.uav, lead.at_tick, lead.cells, lead.allowed) == (5, 1, 7, 1, False)
    result = asynchrony.Result(asynchrony.TRIALS[3], 0, lead, 1.0, None)
    assert not result.passed and result.row().endswith("TOO FAR AHEAD")
