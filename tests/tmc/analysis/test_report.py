"""The report fits a screen, whatever happened, and says what matters."""

import dataclasses

import pytest

from tmc.analysis.metrics import summary
from tmc.analysis.report.text import pictures, text

SCENARIO_1 = {"scenario": 1, "team.controller": "planner:greedy", "training.episodes": 2, "world.alpha": 0.2}


@pytest.fixture(params=["fly", "events", "training"])
def any_summary(request, fly, learned):
    values = SCENARIO_1 if request.param == "events" else {}
    return summary(learned if request.param == "training" else fly(**values))


def fits(report, allowed=3):
    lines = report.splitlines()
    return len(lines) <= 24 and all(len(line) <= 80 for line in lines[: len(lines) - allowed])


def test_it_fits_a_screen(any_summary, tmp_path):
    made = [tmp_path / "report" / name for name in ("map.png", "paths.png", "curves.png")]
    report = "\n".join([text(any_summary, reserve=1), pictures(made)])
    assert fits(report)
    assert "{curves.png,map.png,paths.png}" in report and "..." not in report


def test_it_fits_with_many_notes_and_crashes(any_summary, tmp_path):
    health = dataclasses.replace(
        any_summary.health,
        notes=tuple(f"uav-{i:03d}.mcap: a record of unknown kind 17, at byte 1234567 of this file" for i in range(40)),
        exit_codes={f"uav-{i:03d}": -9 for i in range(40)},
        restarts={f"uav-{i:03d}": 3 for i in range(40)},
    )
    mission = dataclasses.replace(any_summary.mission, seed=10**15, uavs=1000, episodes_planned=10**7)
    report = text(dataclasses.replace(any_summary, health=health, mission=mission), reserve=1)
    report = "\n".join([report, pictures([tmp_path / "map.png"])])
    assert fits(report)
    assert "and more: see summary.json" in report and "uav-000 ended with -9" in report


def test_it_says_the_numbers(fly):
    s = summary(fly())
    report = text(s)
    assert f"{s.last.per_cell:.4f}" in report and f"{s.last.times_bound:.3f}" in report
    assert "1 of 1, of 60 ticks of 60 s; seed 3" in report
    assert f"{s.blocked_share:.2%} of 180 moves: UAVs {s.blocked_uav}," in report
    assert "Pictures" not in report and "Events" not in report and "Learning" not in report


def test_scenario_1_and_training_say_more(fly, learned):
    events = text(summary(fly(**SCENARIO_1)))
    assert "Active events, mean over ticks" in events and "appeared" in events and "mean of 2 episodes" in events
    assert "updates" in text(summary(learned)) and "UAVs in training" in text(summary(learned))


def test_first_best_and_last_are_named_once_each(fly):
    s = summary(fly(**SCENARIO_1))
    one, two = s.episodes
    report = text(dataclasses.replace(s, first=one, best=two, last=two))
    assert "first: episode 1" in report and "last, best: episode 2" in report
    report = text(dataclasses.replace(s, first=one, best=dataclasses.replace(one, episode=7), last=two))
    assert "best: episode 7" in report and "last: episode 2" in report
