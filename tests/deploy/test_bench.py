"""`overfly bench`: a table of benches, each figure beside its reference, as text or as lines of JSON."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

from deploy import cli
from deploy.benches import cores, rollout
from deploy.benches.row import Row, text

TINY = ("bench", "rollout", "--actors", "1,2", "--ticks", "50", "--repeats", "1")


def test_rollout_prints_a_line_of_json_a_figure(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*TINY, "--transport", "both", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    cases = {row["case"]: row for row in rows}
    for n in (1, 2):
        assert cases[f"N={n} one process"]["value"] > 0
        for transport in ("table", "beacons"):
            rate = cases[f"N={n} {transport}"]
            assert rate["value"] > 0 and rate["unit"] == "UAV steps/s"
            assert rate["ratio"] == pytest.approx(rate["value"] / rate["reference"])
            assert 0 < cases[f"N={n} {transport} start"]["value"] < 60
    assert cases["N=2 table beacons"]["value"] == 0
    assert cases["N=2 beacons beacons"]["value"] > 0
    for row in rows:
        assert {"bench", "case", "value", "unit", "reference", "ratio", "platform", "cores", "load", "numpy"} <= set(
            row
        )
        assert len(row["cores_worth"]) == 2


def test_journal_prints_a_line_of_json_a_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny = ["--actors", "2", "--ticks", "100", "--repeats", "1", "--seconds", "0.3", "--dir", str(tmp_path)]
    assert cli.main(["bench", "journal", *tiny, "--json"]) == 0
    rows = {row["case"]: row for row in map(json.loads, capsys.readouterr().out.splitlines())}
    for case in ("none", "process", "power"):
        assert rows[case]["value"] > 0 and rows[case]["unit"] == "records/s"
        share = next(row for name, row in rows.items() if name.startswith(f"{case} at "))
        assert 0 < share["value"] < 2
    for case in ("process commit", "power commit", "fsync"):
        assert 0 < rows[case]["value"] < 10_000
    for case in ("all topics of all files, sealed", "flight records alone, sealed"):
        assert 0 < rows[case]["value"] < rows[case]["reference"]
    assert rows["log check of 200 UAV steps"]["value"] > 0
    assert list(tmp_path.iterdir()) == []
    assert cli.main(["bench", "journal", "--dir", str(tmp_path / "gone")]) == 2
    assert "is no folder: choose one" in capsys.readouterr().err


def rows_of(capsys: pytest.CaptureFixture[str], *command: str) -> dict[str, Any]:
    """What a bench prints, by case and what the reference is."""
    assert cli.main(["bench", *command, "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    return {f"{row['case']} {row['what']}".strip(): row for row in rows}


def test_replay_weighs_and_draws(capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(capsys, "replay", "--minibatches", "3", "--set", "replay.capacity=9000", "--set", "dqn.batch=16")
    assert 20 < rows["9,000 transitions of what is asked"]["value"] < 100
    assert 8 < rows["9,000 transitions with priorities of what is asked"]["value"] - 46 < 20
    assert rows["a minibatch of 16 of what is asked"]["value"] > 0
    assert rows["prioritised, and its update of what is asked"]["value"] > 0
    assert rows["inserts of what is asked"]["value"] > 0


def test_actor_holds_a_step_against_its_network(capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(capsys, "actor", "--repeats", "1", "--ticks", "60", "--actors", "2")
    step = rows["N=2 a whole step the call of ONNX Runtime / step"]
    assert step["ratio"] > 0  # below 1 but for the noise of so short a run
    assert step["ratio"] == pytest.approx(step["reference"] / step["value"], rel=0.01)


def test_learner_is_held_against_the_bare_loop(capsys: pytest.CaptureFixture[str]) -> None:
    """A small mission in real processes; every value it needs is kept, and the results are the bare loop's."""
    small = ["replay.capacity=200", "dqn.target_updates=10", "dqn.batch=16", "network.channels=4,4"]
    changes = [part for change in small for part in ("--set", change)]
    turns = ["--repeats", "1", "--seconds", "0.3", "--threads", "1", "--steps", "40"]
    rows = rows_of(capsys, "learner", *turns, "--actors", "2", "--ticks", "200", *changes)
    rate = rows["N=2 threads=1 x bare loop"]
    assert rate["value"] > 0 and rate["ratio"] == pytest.approx(rate["value"] / rate["reference"])
    assert 0 <= rows["N=2 threads=1 idle"]["value"] <= 1
    assert rows["N=2 threads=1 learner"]["value"] > 0
    departure = rows["40 steps x rounding alone"]
    assert departure["value"] < 10 * departure["reference"] < 1e-3


def test_train_counts_the_ticks_of_the_whole_recipe(capsys: pytest.CaptureFixture[str]) -> None:
    small = ["replay.capacity=200", "dqn.target_updates=10", "dqn.batch=16", "network.channels=4,4"]
    changes = [part for change in small for part in ("--set", change)]
    rows = rows_of(capsys, "train", "--repeats", "1", "--seconds", "0.3", "--threads", "1", "--actors", "2", *changes)
    assert rows["N=2 x bare loop"]["value"] > 0
    assert 0 < rows["N=2 start"]["value"] < 60
    assert 50 < rows["N=2 memory"]["value"] < 4096


def test_startup_says_how_long_a_user_waits(capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(capsys, "startup", "--repeats", "1", "--warm", "0", "--actors", "1", "--set", "network.channels=4,4")
    for case in ("run quick, N=1", "actor alone"):
        row = rows[f"{case} of what is asked"]
        assert 0.05 < row["value"] < 120 and row["ratio"] == pytest.approx(row["value"] / row["reference"])
    parts = [rows[f"{case} x an empty Python"] for case in ("--help", "import actors", "import learner")]
    assert all(row["value"] > 0 and row["reference"] > 0 for row in parts)


def test_memory_is_told_by_role(capsys: pytest.CaptureFixture[str]) -> None:
    small = ["replay.capacity=300", "dqn.batch=16", "network.channels=4,4", "replay.learn_start=40"]
    changes = [part for change in small for part in ("--set", change)]
    rows = rows_of(capsys, "memory", "--transitions", "100", "--actors", "2", "--ticks", "100", *changes)
    whole = rows["N=2 of what is asked"]
    assert 50 < whole["value"] < 4096 and whole["ratio"] == pytest.approx(whole["value"] / whole["reference"])
    roles = {case: row["value"] for case, row in rows.items() if case.endswith("of all")}
    assert {f"N=2 {role} of all" for role in ("learner", "supervisor", "tmc", "uavs")} <= set(roles)
    assert sum(roles.values()) == pytest.approx(whole["value"])
    assert rows["replay, 300 transitions of what is asked"]["value"] < 60


@pytest.mark.parametrize(
    "mistake",
    [
        ["learner", "--seconds", "0"],
        ["replay", "--minibatches", "0"],
        ["actor", "--repeats", "0"],
        ["startup", "--repeats", "0"],
        ["memory", "--transitions", "100"],
    ],
)
def test_a_number_that_makes_no_sense_is_one_sentence(mistake: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", *mistake]) == 2
    assert mistake[1] in capsys.readouterr().err


def test_a_mission_that_is_over_before_it_is_measured_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--ticks", "40", "--episodes", "1", "--set", "replay.learn_start=20", "--set", "dqn.batch=8"]
    assert cli.main(["bench", "learner", "--repeats", "1", "--threads", "1", "--seconds", "30", *small]) == 2
    assert "the mission was over before it was measured: give it more --episodes" in capsys.readouterr().err


def test_memory_is_what_the_system_says() -> None:
    memory = rollout.weigh_all({"uav-000": os.getpid()})
    assert memory is not None and 1 < memory.private < 4096 and memory.total > 0
    assert set(memory.roles) == {"uavs", "supervisor"} and sum(memory.roles.values()) == memory.total
    assert rollout.own() == pytest.approx(memory.roles["supervisor"], rel=0.5)
    assert rollout.weigh_all({"uav-000": 2**22 + 1}) is None


def test_what_the_cores_are_worth_is_counted_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    worth = cores.worth()
    assert worth is None or worth > 0.0
    assert cores.main([str(time.monotonic() + 0.2), "1"]) == 0
    alone, together = json.loads(capsys.readouterr().out)
    assert alone > 0 and together > 0
    assert cores.main([str(time.monotonic() - 1.0), "1"]) == 0
    assert capsys.readouterr().out == "null\n", "it came too late, and counted all the same"


def test_the_table_has_a_dash_where_nothing_was_measured() -> None:
    table = text(
        [Row("rollout", "N=1 table waits", None, "share of time"), Row("rollout", "N=1", 4321.0, "UAV steps/s")]
    )
    assert " - share of time" in table and "4,321 UAV steps/s" in table


def test_a_mistake_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*TINY[:-1], "0"]) == 2
    assert "--repeats" in capsys.readouterr().err
