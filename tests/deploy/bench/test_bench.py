"""`overfly bench`: a table of benches, each figure beside its reference, as text or as lines of JSON."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy import cli
from deploy.bench import cores, journal, learner, memory, replay, rollout, startup, train
from deploy.bench.row import Row, text
from learner import reference
from learner.target_cache import TargetValueCache
from tmc.center.journal import Journal
from tmc.center.replay import Replay
from tmc.center.roster import Outbox
from tmc.kernel import observation
from tmc.kernel.config import build
from tmc.kernel.world import World

TINY = ("bench", "rollout", "--actors", "1,2", "--ticks", "50", "--repeats", "1")
SMALL = ("replay.capacity=200", "dqn.target_updates=10", "dqn.batch_size=16", "network.channels=4,4")
KEYS = {"bench", "case", "value", "unit", "reference", "ratio", "what"}
MACHINE = {"platform", "processor", "cores", "load", "python", "numpy", "torch", "onnxruntime", "cores_worth"}


def changes(*settings: str) -> list[str]:
    """Return the options that change these settings."""
    return [word for setting in settings for word in ("--set", setting)]


def rows_of(capsys: pytest.CaptureFixture[str], *command: str) -> dict[str, Any]:
    """Run a bench; return its rows by case and reference. Its output is strict JSON, each row with the machine."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    assert cli.main(["bench", *command, "--json"]) == 0
    rows = [json.loads(line, parse_constant=refuse) for line in capsys.readouterr().out.splitlines()]
    for row in rows:
        assert set(row) >= KEYS | MACHINE and row["bench"] == command[0] and len(row["cores_worth"]) == 2
    found = {f"{row['case']} {row['what']}".strip(): row for row in rows}
    assert len(found) == len(rows), "two rows of one name"
    return found


def units(rows: dict[str, Any]) -> dict[str, str]:
    """Return the unit of each row."""
    return {case: row["unit"] for case, row in rows.items()}


def is_in_proportion(row: dict[str, Any]) -> bool:
    """Return whether the ratio of one turn is value / reference; a flight too short to be timed has neither."""
    if row["value"] is None:
        return row["ratio"] is None
    return bool(row["ratio"] == pytest.approx(row["value"] / row["reference"]))


def test_rollout_prints_a_line_of_json_per_figure(capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(capsys, *TINY[1:], "--transport", "both")
    expected = {}
    for n in (1, 2):
        expected[f"N={n} one process"] = "UAV steps/s"
        for name in (f"N={n} table", f"N={n} beacons"):
            expected |= {f"{name} x one process": "UAV steps/s", f"{name} waits": "share of time"}
            expected |= {f"{name} beacons": "beacons/UAV step", f"{name} private of the limit": "MiB, largest UAV"}
            expected |= {
                f"{name} memory of the limit": "MiB in total",
                f"{name} start of the limit": "s to the first tick",
            }
            assert is_in_proportion(rows[f"{name} x one process"]) and is_in_proportion(
                rows[f"{name} start of the limit"]
            )
            assert rows[f"{name} x one process"]["reference"] == rows[f"N={n} one process"]["value"]
            assert rows[f"{name} start of the limit"]["reference"] == rollout.LIMITS["start"]
    assert units(rows) == expected
    beacons = {
        name: rows[f"{name} beacons"]["value"] for name in ("N=1 table", "N=1 beacons", "N=2 table", "N=2 beacons")
    }
    sent = beacons.pop("N=2 beacons")
    assert sent and not any(beacons.values()), "beacons are for two UAVs, and not for those that share a table"


def test_journal_prints_a_line_of_json_per_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny = ["--actors", "2", "--ticks", "100", "--repeats", "1", "--seconds", "0.3", "--dir", str(tmp_path)]
    rows = rows_of(capsys, "journal", *tiny, "--pace", "500")
    once = {"fsync": "ms, median", "log check of 200 UAV steps": "s"}
    for case in ("none", "process", "power"):
        once |= {f"{case} x no commits": "records/s", f"{case} at 500 records/s": "share of a core"}
    for case in ("process", "power"):
        once |= {f"{case} commits": "commits/s", f"{case} commit": "ms, median"}
    compacted = [f"{what}, compacted x as written" for what in ("all topics of all files", "flight records alone")]
    assert units(rows) == once | dict.fromkeys(compacted, "bytes/UAV step")
    assert rows["none x no commits"]["ratio"] == 1 and is_in_proportion(rows["power x no commits"])
    assert all(is_in_proportion(rows[case]) and rows[case]["ratio"] <= 1 for case in compacted)
    assert rows[compacted[1]]["value"] < rows[compacted[0]]["value"], "a part has more bytes than the whole"
    assert list(tmp_path.iterdir()) == []
    assert cli.main(["bench", "journal", "--dir", str(tmp_path / "gone")]) == 2
    assert "is not a folder: choose one" in capsys.readouterr().err


class FakeTime:
    """A clock that only sleep advances, by a microsecond at least."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    perf_counter = process_time = monotonic

    def sleep(self, seconds: float) -> None:
        self.now += max(seconds, 1e-6)


def test_records_per_second_are_those_of_the_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An outbox of 3 records takes 0.1 s: 30 records per second at full speed, or the pace if that is less."""
    clock, world = FakeTime(), World(build({"team.size": 2, "training.ticks": 10}))
    monkeypatch.setattr(journal, "time", clock)
    monkeypatch.setattr(Journal, "take", lambda self, outbox: clock.sleep(0.1))
    monkeypatch.setattr(journal, "records_in", lambda outbox: 3)
    full = journal.stretch(world, journal.NONE, [Outbox()], tmp_path, 10.0)
    assert journal.rate_of(full) == pytest.approx(30) and full.cpu == full.wall and full.commits == []
    paced = journal.stretch(world, journal.NONE, [Outbox()], tmp_path, 10.0, 15.0)
    assert journal.rate_of(paced) == pytest.approx(15, rel=0.03)  # it ends within an outbox of ten seconds


def test_replay_weighs_and_draws(capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(capsys, "replay", "--minibatches", "3", *changes("replay.capacity=9000", "dqn.batch_size=16"))
    cases = ("9,000 transitions", "9,000 transitions with priorities", "process above an empty one",
             "minibatch of 16", "minibatch of 16, fastest", "prioritised, with update", "inserts")  # fmt: skip
    plain, prioritised, _, median, fastest, *_ = found = [rows[f"{case} of the limit"] for case in cases]
    assert len(rows) == len(found)
    assert [row["unit"] for row in found] == ["bytes/transition"] * 2 + ["MB"] + ["ms"] * 3 + ["transitions/s"]
    assert all(is_in_proportion(row) for row in found if row["value"] is not None)
    # The size of a transition follows from the types of its fields, so it is the same everywhere.
    assert 40 < plain["value"] < 50 and 8 <= prioritised["value"] - plain["value"] < 9
    assert fastest["value"] <= median["value"]


def test_a_memory_of_twice_the_transitions_weighs_as_much_each() -> None:
    def each(capacity: int) -> float:
        world = World(build({"replay.capacity": capacity}))
        memory = Replay(world, observation.ObservationBuilder(world))
        inserted, _ = replay.fill(memory)
        assert capacity - 2 <= len(memory) <= inserted
        return replay.weight(memory)

    assert each(12_000) == pytest.approx(each(6_000), rel=0.05)


def test_actor_compares_a_step_with_its_network(capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(capsys, "actor", "--repeats", "1", "--ticks", "60", "--actors", "2")
    step, rate = rows["N=2 whole step ONNX Runtime call / step"], rows["N=2 steps x textbook calls/s, aim 0.4"]
    assert len(rows) == 2 and (step["unit"], rate["unit"]) == ("us", "UAV steps/s")
    assert step["value"] * rate["value"] == pytest.approx(1e6) == step["reference"] * rate["reference"]
    assert step["ratio"] == pytest.approx(step["reference"] / step["value"]) == rate["ratio"]


CPU = {f"N=2 threads=1 {role}": "ms of processor time per update" for role in ("learner", "tmc", "uavs")}


def test_learner_is_compared_with_the_textbook_loop(capsys: pytest.CaptureFixture[str]) -> None:
    """A small mission in real processes, and the learner's gradients: exact within what float32 can round.

    How far that is follows from float32's eps, the numbers of terms and the sizes of the numbers (`learner.rounding`),
    so it holds on every processor. The real rounding error depends on the processor: it is printed, not asserted.
    """
    turns = ["--repeats", "1", "--seconds", "0.3", "--threads", "1", "--steps", "40"]
    rows = rows_of(capsys, "learner", *turns, "--actors", "2", "--ticks", "200", *changes(*SMALL))
    plain, tuned = (rows[f"N=2 threads=1 x textbook loop{name}"] for name in ("", f" {learner.TUNED}"))
    assert plain["unit"] == "updates/s" and is_in_proportion(plain) and is_in_proportion(tuned)
    assert plain["value"] == tuned["value"]
    assert CPU.items() <= units(rows).items()
    idle = rows["N=2 threads=1 idle"]["value"]
    assert idle is None or 0 <= idle <= 1
    worst = rows["40 steps, worst weight x float32's bound"]
    assert worst["value"] <= worst["reference"] == 1 and is_in_proportion(worst)
    assert is_in_proportion(rows["40 steps x textbook loop's rounding"])


def compared(**changes: Any) -> tuple[Row, Row]:
    """Return only the rows of the comparison, for a small mission."""
    small = {"replay.capacity": 200, "dqn.target_updates": 10, "dqn.batch_size": 16, "network.channels": (4, 4)}
    departure, worst = learner.compare(World(build({**learner.MISSION, **small, "team.size": 2, **changes})), 40)
    return departure, worst


def test_a_wrong_learner_shows_in_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    """A target value that is kept after theta- has changed is outside the bound, and far more than rounding."""
    _, worst = compared()
    assert worst.value is not None and worst.value <= 1
    monkeypatch.setattr(TargetValueCache, "forget", lambda self: None)
    departure, worst = compared()
    assert worst.value is not None and worst.value > 1
    assert departure.ratio is not None and departure.ratio > 1000


def test_results_without_any_rounding_have_no_ratio(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reference, "departures", lambda config, batches: reference.Departures(0.0, 0.0, 0.0))
    departure, worst = compared()
    assert (departure.value, departure.reference, departure.ratio) == (0, 0, None)
    assert (worst.value, worst.ratio) == (0, 0)
    monkeypatch.setattr(cores, "worth", lambda: None)
    monkeypatch.setattr(learner, "measure", lambda args: [departure, worst, Row("learner", "lost", float("nan"), "s")])
    rows = rows_of(capsys, "learner")
    assert rows["40 steps x textbook loop's rounding"]["ratio"] is None and rows["lost"]["value"] is None
    assert cli.main(["bench", "learner"]) == 0
    assert "nan" not in capsys.readouterr().out


def flown(rate: float, idle: float | None, **cpu: float) -> learner.Learned:
    return learner.Learned(rate, rate / 2, 1.0, 100.0, idle, cpu)


def test_figures_of_several_turns_are_medians_and_ratios_are_taken_in_pairs() -> None:
    runs = [flown(60, 0.2, learner=10, tmc=2), flown(90, None, learner=20, tmc=1), flown(80, 0.4, learner=30, tmc=3)]
    config = build({"team.size": 3, "training.threads": 2})
    plain, tuned, *rest = learner._rows(config, runs, textbook=[40, 90, 20], tuned=[60, 60, 60])
    assert (plain.value, plain.reference, plain.ratio) == (80, 40, 1.5)  # of 1.5, 1 and 4; not 80 / 40
    assert (tuned.value, tuned.reference, tuned.ratio) == (80, 60, 80 / 60)
    assert [(row.case.split()[-1], row.value) for row in rest] == [
        ("idle", pytest.approx(0.3)),
        ("learner", 20),
        ("tmc", 2),
    ]
    ticks, *_, start, memory = train._rows(3, runs, textbook=[40, 90, 20])
    assert (ticks.value, ticks.reference, ticks.ratio) == (40, 40, 0.75)
    assert (start.value, memory.value) == (1, 100)


def test_train_counts_the_ticks_of_the_whole_recipe(capsys: pytest.CaptureFixture[str]) -> None:
    turns = ["--repeats", "1", "--seconds", "0.3", "--threads", "1", "--actors", "2"]
    rows = rows_of(capsys, "train", *turns, *changes(*SMALL))
    assert is_in_proportion(rows["N=2 x textbook loop"])
    assert units(rows) == {
        "N=2 x textbook loop": "ticks/s",
        "N=2 idle": "share of time",
        **dict.fromkeys(("N=2 learner", "N=2 tmc", "N=2 uavs"), "ms of processor time per update"),
        "N=2 start": "s to the first update",
        "N=2 memory": "MiB in total",
    }


def test_startup_says_how_long_a_user_waits(capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(
        capsys, "startup", "--repeats", "1", "--warm", "0", "--actors", "1", *changes("network.channels=4,4")
    )
    limits = {f"{case} of the limit": limit for case, limit in (("run quick, N=1", "run"), ("actor alone", "actor"))}
    parts = [f"{case} x an empty Python" for case in ("--help", *(f"import {role}" for role in startup.ROLES))]
    assert set(rows) == {*limits, *parts} and all(is_in_proportion(row) for row in rows.values())
    assert {name: rows[name]["reference"] for name in limits} == {
        name: startup.LIMITS[of] for name, of in limits.items()
    }
    assert len({rows[name]["reference"] for name in parts}) == 1, "each beside the same empty Python"


def test_memory_is_given_by_role(capsys: pytest.CaptureFixture[str]) -> None:
    small = ("replay.capacity=300", "dqn.batch_size=16", "network.channels=4,4", "replay.learn_start=40")
    rows = rows_of(capsys, "memory", "--transitions", "100", "--actors", "2", "--ticks", "100", *changes(*small))
    whole, roles = rows["N=2 of the limit"], [row for case, row in rows.items() if case.endswith("of the total")]
    if whole["value"] is None:
        pytest.skip("this system does not tell the memory of a process")
    assert whole["reference"] == memory.LIMIT_MB and is_in_proportion(whole)
    assert {f"N=2 {role}" for role in ("learner", "supervisor", "tmc", "uavs")} <= {row["case"] for row in roles}
    assert sum(row["value"] for row in roles) == pytest.approx(whole["value"])
    assert sum(row["ratio"] for row in roles) == pytest.approx(1)
    assert rows["replay, 300 transitions of the limit"]["unit"] == "MB"


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
    small = ["--ticks", "40", "--episodes", "1", "--set", "replay.learn_start=20", "--set", "dqn.batch_size=8"]
    assert cli.main(["bench", "learner", "--repeats", "1", "--threads", "1", "--seconds", "0.1", *small]) == 2
    assert "the mission was over before it was measured: give it more --episodes" in capsys.readouterr().err


def test_memory_is_what_the_system_says() -> None:
    found = rollout.weigh_all({"uav-000": os.getpid()})
    if found is None:
        pytest.skip("this system does not tell the memory of a process")
    assert set(found.roles) == {"uavs", "supervisor"} and sum(found.roles.values()) == found.total
    assert found.private <= found.roles["uavs"], "what is private counts in full, what is shared in part"
    held = np.ones(2**23)  # 64 MiB
    more = rollout.weigh_all({"uav-000": os.getpid()})
    assert more is not None and more.private - found.private == pytest.approx(held.nbytes / 2**20, rel=0.2)
    assert rollout.weigh_all({"uav-000": 2**22 + 1}) is None


class Counting:
    """The clock of a process in which reading it takes 0.01 s, and everything else takes no time."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        self.now += 0.01
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now += seconds


def test_a_core_counts_as_much_alone_as_together(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a clock that no other process can slow down both are equal. A process that is late does not count."""
    monkeypatch.setattr(cores, "time", Counting())
    assert cores.main(["101", "1"]) == 0
    alone, together = json.loads(capsys.readouterr().out)
    assert alone == pytest.approx(100 * cores.COUNT_S, abs=2) and together == pytest.approx(alone, abs=2)
    assert cores.main(["103", "0"]) == 0
    assert json.loads(capsys.readouterr().out) == [0, pytest.approx(100 * cores.COUNT_S, abs=2)]
    assert cores.main(["100", "1"]) == 0
    assert capsys.readouterr().out == "null\n", "it started too late, and counted nevertheless"


@pytest.mark.parametrize(
    ("counts", "worth"), [(["[10, 8]", "[0, 9]"], 1.7), (["[10, 8]", "null"], None), (["[0, 3]", "[0, 0]"], 3.0)]
)
def test_what_the_cores_are_worth_is_all_at_once_over_one_alone(
    counts: list[str], worth: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`counts`: what the processes print, the first of which counts alone first; null: it started too late."""
    monkeypatch.setattr(cores.helper, "start", lambda _module, _start, first, **_: first)
    monkeypatch.setattr(cores.helper, "output_of", lambda first: counts[0 if first else 1])
    monkeypatch.setattr(cores, "core_count", lambda: 2)
    assert cores.worth() == worth


def test_the_table_has_a_dash_where_nothing_was_measured() -> None:
    table = text(
        [Row("rollout", "N=1 table waits", None, "share of time"), Row("rollout", "N=1", 4321.0, "UAV steps/s")]
    )
    assert " - share of time" in table and "4,321 UAV steps/s" in table
    table = text([Row("rollout", "N=1", float("nan"), "UAV steps/s", 5.0, float("nan"), "x one process")])
    assert " - UAV steps/s" in table and "nan" not in table


def test_a_mistake_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*TINY[:-1], "0"]) == 2
    assert "--repeats" in capsys.readouterr().err
