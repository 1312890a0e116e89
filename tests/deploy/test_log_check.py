"""`overfly log check | recover | compact` as a user calls them: what they print, and their exit codes."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from deploy.cli import main
from deploy.commands import log_check
from tmc.record.reader import Log
from tmc.record.writer import LogWriter


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("check") / "R"
    assert main(["fly", "planner:greedy", "--lockstep", "--ticks", "60", "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def run(flown: Path, tmp_path: Path) -> Path:
    """Return a copy of a run folder."""
    shutil.copytree(flown, tmp_path / "R", ignore=shutil.ignore_patterns("report"))
    return tmp_path / "R"


def damage(path: Path) -> None:
    """Flip one bit in the data of the first chunk."""
    data = bytearray(path.read_bytes())
    data[data.index(b"\x04\x00\x00\x00zstd") + 30] ^= 1
    path.write_bytes(data)


def test_check_prints_a_line_per_invariant(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["log", "check", str(run)]) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines[0].split() == ["invariant", "what", "is", "compared", "facts"]
    assert len(lines) == 25 and all(re.search(r" [\d,]+  (ok|-)$", line) for line in lines[1:23])
    said = lines[24].removeprefix(f"{run}/tmc.mcap: ")
    assert re.fullmatch(r"1 episode, [\d,]+ facts, all invariants hold in \d+\.\d s", said)
    progress = r"checked episode 1: \d+%"  # on a machine so slow that the check takes seconds
    assert all(re.fullmatch(progress, line) for line in printed.err.splitlines())


def test_check_of_damage_is_exit_code_1(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damage(run / "tmc.mcap")
    assert main(["log", "check", str(run)]) == 1
    out = capsys.readouterr().out
    assert re.search(r"^file .* VIOLATED: tmc\.mcap: .*, at byte \d+$", out, re.MULTILINE)


def test_cat_of_damage_prints_what_is_intact_and_says_that_it_is_incomplete(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(run / "tmc.mcap")
    assert main(["log", "cat", str(run)]) == 1
    said = capsys.readouterr()
    assert re.fullmatch(r"overfly: the output is incomplete: tmc\.mcap: .*, at byte \d+\n", said.err)


def test_recover_of_a_run(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["log", "recover", str(run)]) == 0
    assert "intact and finished" in capsys.readouterr().out
    damage(run / "tmc.mcap")
    assert main(["log", "recover", str(run)]) == log_check.LOSS
    out = capsys.readouterr().out
    assert f"they are in {run / 'tmc.recovered.mcap'}" in out and "lost" in out
    assert main(["log", "check", str(run)]) == 1  # the original is as it was
    assert main(["log", "recover", str(run)]) == 1  # the file is there already
    assert "exists already" in capsys.readouterr().err
    assert main(["log", "recover", str(run), "--in-place"]) == log_check.LOSS
    assert Log(run / "tmc.mcap").damage is None
    assert main(["log", "check", str(run)]) == 1
    assert "VIOLATED: lost: " in capsys.readouterr().out


def test_recover_of_a_file(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = run / "tmc.mcap", tmp_path / "recovered.mcap"
    path.write_bytes(path.read_bytes()[:-2000])
    assert main(["log", "recover", str(path), "--out", str(out)]) in (0, log_check.LOSS)
    assert Log(out).finished
    assert main(["log", "recover", str(tmp_path / "gone.mcap")]) == 2
    assert main(["log", "recover", str(run / "config.json")]) == 2
    assert main(["log", "recover", str(run), "--out", str(out)]) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 3 and all(line.startswith("overfly: ") for line in err)
    with pytest.raises(SystemExit, match="2"):
        main(["log", "recover", str(path), "--out", "x.mcap", "--in-place"])


def test_seal(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "tmc.mcap").rename(run / "tmc.mcap.active")
    assert main(["log", "compact", str(run)]) == 0
    lines = capsys.readouterr().out.splitlines()
    said = lines[0].removeprefix(f"{run}/tmc.mcap: ")
    assert re.fullmatch(r"[\d,]+ bytes before, [\d,]+ after, [\d,]+ messages", said)
    assert re.fullmatch(r"1 files: [\d,]+ bytes before, [\d,]+ after \(\d+%\)", lines[1])
    assert main(["log", "check", str(run)]) == 0
    damage(run / "tmc.mcap")
    capsys.readouterr()
    assert main(["log", "compact", str(run)]) == 1
    assert "overfly log recover" in capsys.readouterr().err


def test_seal_of_a_run_that_is_alive(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = Log(run / "tmc.mcap").metadata()
    from tmc.kernel.config import JournalConfig  # noqa: PLC0415

    with LogWriter(run / "learner.mcap", "learner", JournalConfig(), config):
        assert main(["log", "compact", str(run)]) == 1
    assert "is being written by another process" in capsys.readouterr().err


@pytest.mark.parametrize("view", ["check", "recover", "compact"])
def test_no_run(view: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["log", view, str(tmp_path)]) == 2
    assert "holds no logs of a run" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
