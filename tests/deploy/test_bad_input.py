"""A user's mistake gives one sentence with the fix, exit code 2, no traceback, and leaves no files."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy import settings
from deploy.cli import main
from learner.trainer import Trainer
from tests.command import here
from tmc.kernel.config import SETTINGS, Config, ConfigError
from tmc.kernel.grid import Grid
from tmc.record import channels

CASES = [
    (("run", "fast"), "there is no preset 'fast': choose paper, patrol, quick"),
    (("run", "papper"), "there is no preset 'papper': did you mean paper?"),
    (("run", "paper", "--set", "dqn.gama=1"), "did you mean dqn.gamma?"),
    (("run", "paper", "--set", "trial.ack_early=true"), "--set sets trial.ack_early, which only `overfly verify` may"),
    (("run", "paper", "--set", "team.controller=planner:gredy"), "did you mean planner:greedy?"),
    (("run", "paper", "--map", "downtown-torronto"), "did you mean downtown-toronto?"),
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
    (("fly", "planner:astar"), "there is no planner 'planner:astar': "),
    (("fly", "planner:gredy"), "there is no planner 'planner:gredy': did you mean planner:greedy?"),
    (("fly", "greedy"), "did you mean planner:greedy?"),
    (("fly", "nowhere.onnx"), "not a policy file, a run folder or a planner: write one of these, or planner:"),
    (("evaluate", "planner:greedy", "--seeds", "0"), "--seeds"),
    (("evaluate", "planner:greedy", "--actors", "1,x"), "--actors"),
    (("tmc", "--bind", "here"), "not an endpoint"),
    (("log", "digest", "nowhere"), "nowhere"),
    (("log", "moves", "nowhere"), "nowhere"),
]


UNKNOWN = [
    (("fyl", "planner:greedy"), "there is no command 'fyl': did you mean fly? see `overfly --help`"),
    (("zzz",), "there is no command 'zzz': choose run, fly, evaluate, verify, "),
    (("bench", "lerner"), "there is no bench 'lerner': did you mean learner? see `overfly bench --help`"),
    (("log", "inof", "R"), "there is no view 'inof': did you mean info? see `overfly log --help`"),
    (("map", "exprot"), "there is no view 'exprot': did you mean export?"),
    (("verify", "exactnes"), "there is no check 'exactnes': did you mean exactness?"),
    (
        ("verify", "chaos", "--mode", "flly"),
        "--mode flly is unknown: did you mean fly? see `overfly verify chaos --help`",
    ),
    (("map", "show", "--roads", "maim"), "--roads maim is unknown: did you mean main?"),
    (("run", "paper", "--sead", "3"), "there is no option --sead: did you mean --seed? see `overfly run --help`"),
    (("log", "moves", "R", "--episod=3"), "there is no option --episod: did you mean --episode?"),
    (("fly", "planner:greedy", "--zzz"), "there is no option --zzz; see `overfly fly --help`"),
    (
        ("fly", "planner:greedy", "planner:random"),
        "'planner:random' is one argument too many; see `overfly fly --help`",
    ),
    (("fly",), "the following arguments are required: POLICY; see `overfly fly --help`"),
    (("run", "paper", "--seed"), "argument --seed: expected one argument; see `overfly run --help`"),
]


@pytest.mark.parametrize(("args", "sentence"), UNKNOWN, ids=[" ".join(args) for args, _ in UNKNOWN])
def test_a_name_that_does_not_exist_is_answered_by_the_nearest(args, sentence, tmp_path: Path) -> None:
    done = here(*args, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith(f"overfly: {sentence}") and done.stderr.count("\n") == 1
    assert done.stdout == "" and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["run", "fly", "evaluate", "tmc"])
def test_help_says_what_each_short_option_is(command: str, tmp_path: Path) -> None:
    text = " ".join(here(command, "--help", cwd=tmp_path).stdout.split())
    assert "T_u between two exchanges with the TMC; scenario I always has 1 (1 to 60,000 ticks; default: 10)" in text
    assert "built-in map, or a text raster file (default: downtown-" in text
    episodes = 1 if command == "fly" else 500
    assert (f"E, the number of episodes (1 to 10,000,000 episodes; default: {episodes})" in text) != (
        command == "evaluate"
    )


def test_doctor_lists_every_setting(tmp_path: Path) -> None:
    text = here("doctor", "--settings", cwd=tmp_path).stdout
    assert all(f"{key} = " in text and s.about in text for key, s in SETTINGS.items())
    assert "team.size = 3\n    N, the number of UAVs (1 to 1,000 UAVs) [Sec. IV-C]\n" in text
    assert text.count("[set by `overfly verify` alone]") == sum(s.trial for s in SETTINGS.values())


def test_no_preset_has_a_setting_of_trials() -> None:
    with pytest.raises(ConfigError, match=r"^the preset mine sets trial\.stall, which only `overfly verify` may do"):
        settings.require_settable(["team.size", "trial.stall"], "the preset mine")


@pytest.mark.parametrize(("args", "sentence"), CASES, ids=[" ".join(args) for args, _ in CASES])
def test_a_mistake_is_one_sentence(args, sentence, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(list(args)) == 2
    printed = capsys.readouterr()
    assert sentence in printed.err
    assert printed.err.count("\n") == 1 and printed.err.startswith("overfly: ")
    assert list(tmp_path.iterdir()) == []


def test_a_run_of_another_log_format(tmp_path: Path, monkeypatch) -> None:
    """Whatever reads it says so, since its settings and topics have other names."""
    out = tmp_path / "R"
    with monkeypatch.context() as then:
        then.setattr(channels, "FORMAT", "1")
        assert (
            here(
                "fly", "planner:greedy", "--ticks", "20", "--lockstep", "--no-pictures", "--out", out, cwd=tmp_path
            ).returncode
            == 2
        )  # its own summary cannot be read
    for words in (("log", "info", out), ("log", "check", out), ("log", "merge", out, "--out", tmp_path / "M.mcap"),
                  ("analyze", out), ("fly", out), ("run", "--resume", out), ("evaluate", out)):  # fmt: skip
        done = here(*words, cwd=tmp_path)
        assert done.returncode in (1, 2), words
        assert f"{out / 'tmc.mcap'} was written in log format 1, this version reads 2" in done.stdout + done.stderr


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
