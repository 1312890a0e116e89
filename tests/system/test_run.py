"""`overfly run`: TMC, learner and UAV processes train, end in order, and leave a complete run folder."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command import PATIENCE_S, descendants
from tmc.record.queries import digest
from tmc.record.reader import Log

GREEDY = ("fly", "planner:greedy", "--no-pictures")


@pytest.mark.parametrize("scenario", [1, 2])
def test_a_training_run_ends_with_a_policy_and_a_log(overfly, trained, tmp_path: Path, scenario: int) -> None:
    out = trained(scenario)
    codes = json.loads((out / "run.json").read_text())["exit_codes"]
    assert set(codes.values()) == {0}
    for name in ("tmc.mcap", "learner.mcap", "uav-000.mcap", "uav-002.mcap", "policies/final.onnx", "summary.json"):
        assert (out / name).is_file(), name
    assert not list(out.glob("*.active")) and not (out / "report").exists()
    again = overfly("fly", out, "--ticks", 30, "--out", tmp_path / "F")
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "F" / "report" / "map.png").is_file()


def test_the_learner_draws_one_minibatch_a_tick(here, trained) -> None:
    out = trained(2)
    lines = here("log", "cat", out, "--topic", "/tmc/episode").stdout.splitlines()
    assert len(lines) == 4  # begin and end of two episodes
    updates = here("log", "cat", out, "--topic", "/learner/policy").stdout.splitlines()
    last = json.loads(updates[-1])["message"]
    # 120 ticks; 60 transitions are in at tick 30: at tick 20 the 3-step sums of the last two ticks are not known yet.
    assert int(last["updates"]) == 90


def test_the_log_has_the_time_at_which_the_sender_made_a_message(trained) -> None:
    """publish_time: the wall clock of the UAV, of the learner, or of the TMC itself."""
    under_way: dict[str, list[int]] = {}
    for raw in Log(trained(2) / "tmc.mcap").raw():
        under_way.setdefault(raw.schema, []).append(raw.log_time - raw.publish_time)
    for told in ("overfly.FlightRecord", "overfly.Policy"):
        assert all(ns >= 0 for ns in under_way[told]) and any(under_way[told]), told
    assert set(under_way["overfly.TeamMetrics"]) == set(under_way["overfly.Sync"]) == {0}


@pytest.mark.parametrize(("how", "code"), [((), 1), (("--lockstep",), 2)])
def test_a_training_that_diverges_says_so_once(here, tmp_path: Path, how: tuple[str, ...], code: int) -> None:
    wild = ("dqn.learning_rate=10", "dqn.target_updates=1", "dqn.gamma=1", "dqn.loss=mse", "dqn.reward_scale=1000")
    small = ("--ticks", 200, "--set", "replay.learn_start=30", "--set", "dqn.batch_size=8", "--no-pictures")
    done = here("run", "quick", *how, *small, *(x for s in wild for x in ("--set", s)), "--out", tmp_path / "R")
    assert done.returncode == code, done.stderr
    assert done.stderr.count("diverged") == 1 and "lower dqn.learning_rate or dqn.reward_scale" in done.stderr
    assert "Traceback" not in done.stderr and "started again" not in done.stderr


def test_the_mend_that_evaluate_names_is_one(here, tmp_path: Path) -> None:
    for period in (5, 10):
        fly = (*GREEDY, "--lockstep", "--actors", 2, "--ticks", 20, "--tu", period, "--out", tmp_path / str(period))
        assert here(*fly).returncode == 0
    both = ("evaluate", tmp_path / "5", tmp_path / "10", "--seeds", 1)
    refused = here(*both)
    assert refused.returncode == 2 and "the runs differ in comms.period: set it for all of them" in refused.stderr
    assert here(*both, "--set", "comms.period=10").returncode == 0


def test_who_is_named_twice_is_flown_once(here) -> None:
    once, twice = (
        here("evaluate", *who, "--seeds", 2, "--ticks", 20, "--json", "--jobs", 1).stdout
        for who in (["planner:random"], ["planner:random"] * 2)
    )
    same = [{k: v for k, v in json.loads(text).items() if k != "seconds"} for text in (once, twice)]
    assert same[0] == same[1]


def test_a_signal_ends_an_evaluation_and_all_its_processes(running, tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-m", "deploy.cli", "evaluate", "planner:greedy", "--seeds", "4000", "--jobs", "2"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as run:
        assert run.stderr is not None and "missions" in run.stderr.readline()
        workers = descendants(run.pid)
        run.terminate()
        assert run.wait(PATIENCE_S) == 143
    until = time.monotonic() + PATIENCE_S
    while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < until:
        time.sleep(0.05)
    assert workers and not any(Path(f"/proc/{pid}").exists() for pid in workers)


def test_a_check_whose_reader_leaves_did_not_succeed(here, tmp_path: Path) -> None:
    assert here(*GREEDY, "--lockstep", "--ticks", 400, "--out", tmp_path / "R").returncode == 0
    command = [sys.executable, "-P", "-m", "deploy.cli", "log", "cat", str(tmp_path / "R")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as cat:
        assert cat.stdout is not None and cat.stderr is not None
        cat.stdout.readline()
        cat.stdout.close()
        assert (cat.wait(PATIENCE_S), cat.stderr.read()) == (141, b"")


def test_a_run_folder_that_exists_is_refused(here, tmp_path: Path) -> None:
    out = tmp_path / "R"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    done = here("run", "quick", "--out", out)
    assert done.returncode == 2
    assert "exists" in done.stderr and "--out" in done.stderr and "Traceback" not in done.stderr
    assert [p.name for p in out.iterdir()] == ["precious.txt"]


def test_a_uav_that_is_killed_comes_back_and_the_run_goes_on(here, running, tmp_path: Path) -> None:
    out = tmp_path / "R"
    mission = (*GREEDY, "--actors", "3", "--ticks", "2500")
    command = [sys.executable, "-P", "-m", "deploy.cli", *mission]
    with subprocess.Popen([*command, "--out", str(out)], cwd=tmp_path, stderr=subprocess.PIPE, text=True) as run:
        killed = kill_when_up(running, "actors --id 1 --connect ipc:///", str(out), out / "uav-001.mcap.active")
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors
    assert killed and "uav-001 was killed by SIGKILL; it is started again" in errors
    reference = tmp_path / "reference"
    assert here(*mission, "--lockstep", "--out", reference).returncode == 0
    assert digest(out) == digest(reference)


def kill_when_up(running: Callable[[str], list[int]], marker: str, out: str, log: Path) -> bool:
    """Send SIGKILL to the process whose command line holds both texts, once it flies."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        both = set(running(marker)) & set(running(out))
        if both and log.exists():
            time.sleep(0.2)
            os.kill(both.pop(), signal.SIGKILL)
            return True
        time.sleep(0.02)
    return False


def test_ctrl_c_ends_in_order(running, tmp_path: Path) -> None:
    out = tmp_path / "R"
    command = [sys.executable, "-P", "-m", "deploy.cli", "run", "patrol", "--actors", "2", "--out", str(out)]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as run:
        until = time.monotonic() + PATIENCE_S
        while not (out / "learner.mcap.active").exists() and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(1.0)
        run.send_signal(signal.SIGINT)
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 130
    assert "stopped; what was flown is in" in errors and "Traceback" not in errors
    assert (out / "tmc.mcap").is_file() and (out / "learner.mcap").is_file()


def test_children_die_with_a_supervisor_that_is_killed(running, tmp_path: Path) -> None:
    out = tmp_path / "R"
    command = [sys.executable, "-P", "-m", "deploy.cli", "run", "patrol", "--actors", "2", "--out", str(out)]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL) as run:
        until = time.monotonic() + PATIENCE_S
        while len(running(str(out))) < 5 and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(0.5)
        run.kill()
    until = time.monotonic() + PATIENCE_S
    while running(str(out)) and time.monotonic() < until:
        time.sleep(0.05)
    assert running(str(out)) == []


def test_two_runs_side_by_side(tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-m", "deploy.cli", *GREEDY, "--actors", "3", "--ticks", "300"]
    runs = [
        subprocess.Popen([*command, "--out", str(tmp_path / name)], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        for name in "ab"
    ]
    errors = [run.communicate(timeout=PATIENCE_S)[1] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], errors


def rows(text: str) -> list[list[str]]:
    return list(csv.reader(io.StringIO(text)))


@pytest.mark.parametrize("options", [(), ("--set", "comms.phase=staggered"), ("--scenario", "1")])
def test_processes_fly_what_the_lock_step_fleet_flies(overfly, here, tmp_path: Path, options: tuple[str, ...]) -> None:
    for name, fly, more in (("a", overfly, ()), ("b", here, ("--lockstep",))):
        done = fly(*GREEDY, "--actors", 5, "--ticks", 200, "--seed", 7, *options, *more, "--out", tmp_path / name)
        assert done.returncode == 0, done.stderr
    digests = [here("log", "digest", tmp_path / name).stdout.split()[-1] for name in "ab"]
    assert digests[0] == digests[1] and len(digests[0]) == 64


@pytest.mark.parametrize("scenario", [1, 2])
def test_an_outside_simulator_gets_the_same_uncertainty(overfly, here, tmp_path: Path, scenario: int) -> None:
    """Recompute eqs. (1)-(4) and (6) from the CSV of map, moves and events alone, without Overfly's code."""
    out = tmp_path / "R"
    assert overfly("fly", "planner:random-road", "--actors", 6, "--ticks", 150, "--scenario", scenario,
                   "--no-pictures", "--out", out).returncode == 0  # fmt: skip
    grid = [[int(v) for v in row] for row in rows(here("map", "export", "downtown-toronto").stdout)]
    size = len(grid[0])
    road = {r * size + c for r, row in enumerate(grid) for c, v in enumerate(row) if v == 1}
    blocked = {r * size + c for r, row in enumerate(grid) for c, v in enumerate(row) if v == 2}
    assert len(road) == 323 and len(blocked) == 21
    moves: dict[int, dict[int, int]] = {}
    for tick, uav, cell in rows(here("log", "moves", out, "--episode", 1).stdout)[1:]:
        moves.setdefault(int(tick), {})[int(uav)] = int(cell)
    events: dict[int, set[int]] = {}
    for tick, cell in rows(here("log", "events", out, "--episode", 1).stdout)[1:]:
        events.setdefault(int(tick), set()).add(int(cell))
    values = {int(t): float(v) for t, v in rows(here("log", "uncertainty", out, "--episode", 1).stdout)[1:]}
    assert sorted(moves) == sorted(values) == list(range(151))
    outside_simulator(moves, events, values, road, blocked, size, scenario)


def outside_simulator(moves, events, values, road, blocked, size, scenario) -> None:
    last, active = dict.fromkeys(road, 0), set()
    for t in sorted(moves):
        cells = moves[t]
        assert len(set(cells.values())) == len(cells)
        for uav, cell in cells.items():
            assert 0 <= cell < size * size and cell not in blocked
            if t:
                (r0, c0), (r1, c1) = divmod(moves[t - 1][uav], size), divmod(cell, size)
                assert max(abs(r0 - r1), abs(c0 - c1)) <= 1
            if cell in road:
                last[cell] = t
        active = (active - set(cells.values())) | events.get(t, set())
        assert active <= road
        u = len(active) if scenario == 1 else sum(1 - math.exp(-0.01 * (t - tau)) for tau in last.values())
        assert values[t] == pytest.approx(u, abs=1e-9)
