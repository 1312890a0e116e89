"""A user's mistake gives one sentence with the fix, exit code 2, no traceback, and leaves no files."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.cli import main
from learner.trainer import Trainer
from tmc.kernel.config import Config
from tmc.kernel.grid import Grid

CASES = [
    (("run", "fast"), "there is no preset 'fast'"),
    (("run", "paper", "--map", "atlantis"), "atlantis"),
    (("run", "paper", "--set", "gamma=1"), "did you mean dqn.gamma"),
    (("run", "paper", "--set", "dqn.gamma"), "has no value"),
    (("run", "paper", "--set", "dqn.gamma=2"), "out of range"),
    (("run", "paper", "--set", "dqn.gamma=nan"), "dqn.gamma"),
    (("run", "paper", "--set", "dqn.loss=l1"), "mse, huber"),
    (("run", "paper", "--actors", "400"), "larger than the 323 road cells"),
    (("run", "paper", "--actors", "three"), "not of type int"),
    (("run", "paper", "--actors", "0"), "out of range"),
    (("run", "paper", "--tu", "0"), "comms.period = 0 is out of range"),
    (("run", "paper", "--scenario", "3"), "scenario = 3 is out of range"),
    (("run", "paper", "--set", "world.rates=lunar"), "lunar"),
    (("run", "paper", "--set", "network.kernel=20"), "network"),
    (("run", "paper", "--set", "dqn.batch_size=50000"), "choose 25970 or less"),
    (("fly", "planner:astar"), "there is no planner"),
    (("fly", "nowhere.onnx"), "no policy file and no run folder"),
    (("evaluate", "planner:greedy", "--seeds", "0"), "--seeds"),
    (("evaluate", "planner:greedy", "--actors", "1,x"), "--actors"),
    (("tmc", "--bind", "here"), "not an endpoint"),
    (("log", "digest", "nowhere"), "nowhere"),
    (("log", "moves", "nowhere"), "nowhere"),
]


@pytest.mark.parametrize(("args", "sentence"), CASES, ids=[" ".join(args) for args, _ in CASES])
def test_a_mistake_is_one_sentence(args, sentence, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(list(args)) == 2
    printed = capsys.readouterr()
    assert sentence in printed.err
    assert printed.err.count("\n") == 1 and printed.err.startswith("overfly: ")
    assert list(tmp_path.iterdir()) == []


def test_a_policy_file_that_is_none(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.onnx").write_bytes(b"not a model")
    assert main(["fly", "bad.onnx"]) == 2
    assert "overfly: bad.onnx: the file is text, not an ONNX model" in capsys.readouterr().err


def test_a_policy_for_another_grid(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("big.onnx").write_bytes(Trainer(Config(), (3, 40, 40), Grid(40, 40)).policy()[1])
    assert main(["fly", "big.onnx"]) == 2
    printed = capsys.readouterr().err
    assert "40 x 40" in printed and "30 x 30" in printed and "trained on" in printed
    assert not Path("runs").exists()


def test_an_episode_that_was_not_flown(tmp_path: Path, capsys) -> None:
    out = str(tmp_path / "R")
    assert main(["fly", "planner:greedy", "--ticks", "20", "--lockstep", "--out", out]) == 0
    assert main(["log", "moves", out, "--episode", "9"]) == 2
    assert "ask for one of 1" in capsys.readouterr().err


def test_a_log_cut_short_is_read_as_far_as_it_goes(tmp_path: Path, capsys) -> None:
    out = tmp_path / "R"
    assert main(["fly", "planner:greedy", "--ticks", "200", "--lockstep", "--out", str(out)]) == 0
    log = out / "tmc.mcap"
    log.write_bytes(log.read_bytes()[:-3000])
    capsys.readouterr()
    assert main(["log", "info", str(out)]) == 0
    assert "cut" in capsys.readouterr().err
