"""Files and settings from elsewhere: what is wrong with them gives one sentence, before anything starts if possible.

A run folder is enough to resume a run, at any place.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import onnx
import pytest
import torch

from deploy.cli import main
from deploy.policy_spec import resolve
from learner.trainer import Trainer
from tests.command import LINE, here, overfly
from tmc.kernel.config import Config, build
from tmc.kernel.grid import Grid
from tmc.kernel.policy import view_shape
from tmc.record.queries import digest
from tmc.wire.sockets import free_port

EGO = {"observation.view": "ego", "observation.radius": 4, "network.channels": (4,), "network.dense": 8}
TOWN = "name: Old town\ncell_m: 20\n##########\n#...X....#\n#.......X#\n##########\n"


def policy_of(config: Config, bad: float | None = None) -> bytes:
    """Return a policy with the initial weights, one of which is replaced by a bad value."""
    trainer = Trainer(config, view_shape(config, grid := Grid(30, 30)), grid)
    if bad is not None:
        with torch.no_grad():
            trainer.online.out.bias[4] = bad
    return trainer.policy()[1]


def one_sentence(code: int, printed: pytest.CaptureFixture[str]) -> str:
    err = printed.readouterr().err
    assert code in (1, 2) and err.startswith("overfly: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


# Policies


@pytest.fixture(scope="module")
def bad_policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policies") / "bad.onnx"
    path.write_bytes(policy_of(build(EGO), float("nan")))
    return path


def test_values_that_are_not_finite_end_a_mission_of_processes(bad_policy: Path, tmp_path: Path) -> None:
    """No process is restarted, and the sentence names the file, the UAV and the tick."""
    done = overfly("fly", bad_policy, "--actors", 2, "--ticks", 40, "--out", "R", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    told = [line for line in done.stderr.splitlines() if "not finite" in line]
    assert len(told) == 1 and "stops at tick 0 of episode 1: policy 1 gave values that are not finite (" in told[0]
    assert f"(policy 1 is {bad_policy})" in told[0] and "UAV " in told[0]
    assert "Traceback" not in done.stderr and "started again" not in done.stderr
    run = json.loads((tmp_path / "R" / "run.json").read_text())
    assert run["restarts"] == {} and 2 in run["exit_codes"].values()


def test_values_that_are_not_finite_end_a_mission_in_lock_step(bad_policy: Path, tmp_path: Path) -> None:
    done = here("fly", bad_policy, "--lockstep", "--ticks", 40, "--out", "R", cwd=tmp_path)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert done.stderr.count("UAV 0 stops at tick 0 of episode 1: policy 1 gave values that are not finite") == 1
    assert f"(policy 1 is {bad_policy})" in done.stderr


@pytest.mark.parametrize("jobs", [1, 2])
def test_values_that_are_not_finite_end_an_evaluation(bad_policy: Path, tmp_path: Path, jobs: int) -> None:
    done = overfly("evaluate", bad_policy, "--seeds", 3, "--ticks", 20, "--jobs", jobs, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1 and f"{bad_policy}, seed 1000000: UAV 0 stops at tick 0" in done.stderr


def test_a_file_that_is_no_policy_is_named(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p.onnx").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    model = onnx.load_from_string(policy_of(build(EGO)))
    model.ir_version = 99
    Path("new.onnx").write_bytes(model.SerializeToString())
    Path("big.onnx").touch()
    os.truncate("big.onnx", 70_000_000)  # of holes
    for command in ("fly", "evaluate"):
        for name, words in (
            ("p.onnx", "fetch it with `git lfs pull`"),
            ("new.onnx", "(Unsupported model IR version: 99, max supported"),
            ("big.onnx", "it has 70,000,000 bytes, and a policy may have 67,108,864"),
        ):
            said = one_sentence(main([command, name]), capsys)
            assert said.startswith(f"overfly: {name}: ") and words in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["big.onnx", "new.onnx", "p.onnx"]


# Pipes, sockets and devices


@pytest.fixture
def anomalies(tmp_path: Path) -> Iterator[dict[str, Path]]:
    """Return paths that do not name a file; a process that opened some of them to read would wait for ever."""
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as bound, contextlib.chdir(tmp_path):  # its name may not be long
        bound.bind("socket")
        yield {"pipe": tmp_path / "pipe", "socket": tmp_path / "socket", "device": Path("/dev/zero")}


COMMANDS = ("fly", "evaluate", "fly planner:greedy --map", "map show", "map export", "map check", "run --resume",
            "analyze", "log info", "log cat", "log digest", "log check", "log recover", "log compact", "log merge",
            "log replay")  # fmt: skip


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
def test_what_is_no_file_is_refused_and_never_waited_for(anomalies, kind: str, capsys) -> None:
    for command in COMMANDS:
        said = one_sentence(main([*command.split(), str(anomalies[kind])]), capsys)
        assert str(anomalies[kind]) in said, command
        if command in ("fly", "evaluate", "map show", "fly planner:greedy --map"):
            assert f"it is a {kind}" in said


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", ["config.json", "run.json", "summary.json", "map.txt", "policies/flown.onnx"])
def test_a_pipe_in_a_run_folder_is_never_waited_for(flown: Path, tmp_path: Path, name: str, capsys) -> None:
    run = tmp_path / "R"
    shutil.copytree(flown, run)
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).unlink(missing_ok=True)
    os.mkfifo(run / name)
    assert main(["analyze", str(run), "--no-pictures"]) == 0
    assert main(["log", "check", str(run)]) == 0
    code = main(["evaluate", str(run), "--seeds", "1", "--ticks", "5", "--jobs", "1"])
    assert code == (2 if name == "map.txt" else 0)
    capsys.readouterr()


# Settings


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["paper", "--set", "network.dense=50000"], "PolicyPush.model takes 67,108,864: lower these"),
        (["paper", "--set", "replay.updates_per_tick=0"], "replay.updates_per_tick = 0, so nothing would be learned"),
        (["paper", "--ticks", "5", "--set", "replay.learn_start=7500"], "nothing would be learned: the mission makes"),
        (["paper", "--episodes", "4"], "dqn.target_episodes = 5 is above training.episodes = 4"),
        *(
            (["paper", "--set", f"{key}={value}"], f"{key} = '{value}' is not of type float")
            for key in ("world.alpha", "team.sensing_range", "reward.weight", "dqn.gamma", "journal.commit_interval")
            for value in ("nan", "inf", "-inf", "1e999")
        ),
        (["paper", "--set", "world.alpha=1e308"], "world.alpha = 1e+308 is out of range"),
        (["paper", "--seed", "9" * 5000], "is not of type int"),
    ],
    ids=lambda value: " ".join(value)[:60] if isinstance(value, list) else "",
)  # fmt: skip
def test_settings_that_cannot_work_are_refused_before_anything_starts(args, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command in ("run", "tmc"):
        line = [command, *args, *(["--bind", f"tcp://127.0.0.1:{free_port()}"] if command == "tmc" else [])]
        said = one_sentence(main(line), capsys)
        assert words in said and len(said) < 400
    assert list(tmp_path.iterdir()) == []


def test_what_a_training_will_not_do_is_said_before_it_begins(tmp_path: Path) -> None:
    small = (
        "--ticks",
        40,
        "--episodes",
        1,
        "--set",
        "replay.learn_start=30",
        "--set",
        "dqn.batch_size=8",
        "--no-pictures",
    )
    done = here("run", "quick", "--lockstep", *small, "--out", "R", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "training.publish_every = 100: UAVs fly the initial policy to the end" in done.stderr
    assert "dqn.target_updates = 500: the target network stays as it is" in done.stderr
    quiet = here("fly", "planner:greedy", "--lockstep", "--ticks", 10, "--no-pictures", "--out", "F", cwd=tmp_path)
    assert "will not" not in quiet.stderr and "push_every" not in quiet.stderr


# Run folders


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight over a user's map whose file is gone. Tests must not change it, only read or copy it."""
    folder = tmp_path_factory.mktemp("flown")
    (folder / "town.txt").write_text(TOWN)
    fly = ("fly", "planner:greedy", "--lockstep", "--actors", 2, "--ticks", 30, "--map", "town.txt", "--no-pictures")
    done = here(*fly, "--out", "R", cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / "town.txt").unlink()
    return folder / "R"


def edited(run: Path, to: Path, **values: object) -> Path:
    """Return a copy of a run folder with settings changed in its `config.json`."""
    shutil.copytree(run, to)
    config = json.loads((to / "config.json").read_text())
    (to / "config.json").write_text(json.dumps(config | {key.replace("__", "."): v for key, v in values.items()}))
    return to


def test_a_run_folder_brings_its_map_along(flown: Path, tmp_path: Path) -> None:
    """From another folder, under another name, without the file that the run was started with."""
    shutil.copytree(flown, tmp_path / "moved run")
    both = here("evaluate", "moved run", "planner:random", "--seeds", 1, "--ticks", 20, "--jobs", 1, cwd=tmp_path)
    assert both.returncode == 0 and both.stderr == ""
    again = here("fly", "moved run", "--lockstep", "--no-pictures", "--out", "F", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert "Old town (main, static): 24 road cells of 20 m" in again.stdout
    assert digest(tmp_path / "F") == digest(flown)
    assert (tmp_path / "F" / "map.txt").read_text() == (flown / "map.txt").read_text()
    for command in (("analyze", "moved run", "--no-pictures"), ("log", "check", "moved run")):
        assert here(*command, cwd=tmp_path).returncode == 0
    summary = json.loads((tmp_path / "moved run" / "summary.json").read_text())
    assert (summary["mission"]["map"], summary["mission"]["cell_m"]) == ("Old town", 20.0)
    assert summary["health"]["notes"] == []


def test_processes_fly_over_the_copy_in_the_run_folder(flown: Path, tmp_path: Path) -> None:
    """A mission of processes is resumed after the file of its map is gone."""
    run = tmp_path / "R"
    shutil.copytree(flown, run)
    (run / "run.json").unlink()
    (run / "tmc.mcap").rename(run / "tmc.mcap.active")
    done = overfly("run", "--resume", "R", "--no-pictures", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert digest(run) == digest(flown) and (run / "uav-001.mcap").is_file()


def test_two_runs_over_one_map_may_be_compared(flown: Path, tmp_path: Path) -> None:
    for name in "ab":
        shutil.copytree(flown, tmp_path / name)
    compare = ("evaluate", "a", "b", "--seeds", 1, "--ticks", 10, "--jobs", 1)
    assert here(*compare, cwd=tmp_path).returncode == 0
    (tmp_path / "b" / "map.txt").write_text(TOWN.replace("X", "."))
    differ = here(*compare, cwd=tmp_path)
    assert differ.returncode == 2 and "the runs differ in world.map" in differ.stderr


def test_a_built_in_map_needs_no_copy(tmp_path: Path) -> None:
    fly = ("fly", "planner:greedy", "--lockstep", "--ticks", 5, "--no-pictures", "--out", "R")
    assert here(*fly, cwd=tmp_path).returncode == 0
    assert not (tmp_path / "R" / "map.txt").exists()
    assert resolve(str(tmp_path / "R")).values["world.map"] == "downtown-toronto"


def test_settings_edited_after_the_run_are_named_and_not_used(flown: Path, tmp_path: Path) -> None:
    edited(flown, tmp_path / "R", training__seed=99, training__episodes=20)
    told = here("analyze", "R", "--no-pictures", "--json", cwd=tmp_path)
    summary = json.loads(told.stdout)
    assert told.returncode == 0 and (summary["mission"]["seed"], summary["mission"]["episodes_planned"]) == (1, 1)
    note = "config.json: training.episodes, training.seed changed since the run; the log's settings are used"
    assert summary["health"]["notes"] == [note]
    flies = here("evaluate", "R", "--seeds", 1, "--ticks", 5, "--jobs", 1, cwd=tmp_path)
    assert flies.returncode == 0 and flies.stderr == f"overfly: R: {note}\n"
    size = (tmp_path / "R" / "tmc.mcap").stat()
    for command in ("run", "tmc"):
        line = [command, "--resume", "R", *(["--bind", f"tcp://127.0.0.1:{free_port()}"] if command == "tmc" else [])]
        refused = here(*line, cwd=tmp_path)
        assert refused.returncode == 2 and refused.stderr.count("\n") == 1
        assert "config.json was edited since the run was begun, in training.episodes, training.seed" in refused.stderr
    assert (tmp_path / "R" / "tmc.mcap").stat() == size
    (tmp_path / "R" / "config.json").unlink()
    done = here("run", "--resume", "R", "--no-pictures", cwd=tmp_path)
    assert done.returncode == 0 and done.stderr == "overfly: R was flown to its end: this is its summary\n"


READ_ONLY = ("analyze R", "analyze R --json --no-pictures", "run --resume R", "log check R", "log digest R",
             "log info R", "evaluate R --seeds 1 --ticks 5 --jobs 1")  # fmt: skip


def cannot_write(path: Path) -> bool:
    try:
        (path / "probe").touch()
    except OSError:
        return True
    (path / "probe").unlink()
    return False


@pytest.mark.parametrize("command", READ_ONLY)
def test_a_folder_that_cannot_be_written_is_read(flown: Path, tmp_path: Path, command: str) -> None:
    """By its mode, or, since root may write nevertheless, by a read-only mount."""
    run = tmp_path / "R"
    shutil.copytree(flown, run)
    run.chmod(0o555)
    line = [*LINE, *command.split()]
    if not cannot_write(run):
        alone = ["unshare", "-m", "sh", "-c", 'mount --bind R R && mount -o remount,ro,bind R && exec "$@"', "sh"]
        if shutil.which("unshare") is None or subprocess.run([*alone, "true"], cwd=tmp_path, check=False).returncode:
            pytest.skip("the folder can be written whatever its mode, and nothing can be mounted here")
        line = [*alone, *line]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    run.chmod(0o755)
    assert done.returncode == 0, done.stderr
    assert done.stdout and "Traceback" not in done.stderr
    if "analyze" in command or "resume" in command:
        assert done.stderr.count("R/summary.json cannot be written (") == 1
        assert ("no pictures are made" in done.stderr) is ("--no-pictures" not in command)
        assert "Summary" not in done.stdout
    assert {p.name for p in run.iterdir()} == {p.name for p in flown.iterdir()}


def test_a_summary_that_cannot_be_kept_is_printed(flown: Path, tmp_path: Path) -> None:
    run = tmp_path / "R"
    shutil.copytree(flown, run)
    (run / "summary.json").unlink()
    (run / "summary.json").mkdir()
    done = here("analyze", "R", "--json", cwd=tmp_path)
    assert done.returncode == 0 and json.loads(done.stdout)["mission"]["ticks"] == 30
    assert done.stderr.count("\n") == 1 and "the summary is printed only" in done.stderr
    assert not (run / "summary.new").exists()
