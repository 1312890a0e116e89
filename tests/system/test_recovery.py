"""Real processes killed with SIGKILL: the run resumes with the same result. And runs that cannot be resumed."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from deploy.cli import main
from tests.command import LINE, PATIENCE_S, line_of_trial
from tmc.analysis.invariants.check import check
from tmc.center.journal import journal_in
from tmc.kernel.config import JournalConfig
from tmc.record.mcap import strict
from tmc.record.queries import digest
from tmc.record.reader import Log
from tmc.record.run_folder import RunFolder
from tmc.record.writer import LogWriter

Overfly = Callable[..., subprocess.CompletedProcess[str]]
Running = Callable[[str], list[int]]
FLIGHT = ("fly", "planner:greedy", "--actors", "3", "--ticks", "500", "--seed", "7", "--no-pictures")
SLOW = line_of_trial(stall=0.01)
"""Every UAV stalls a little, so that the mission lasts long enough to be killed in."""


@pytest.fixture(scope="module")
def reference_digest(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the digest of the flight without kills."""
    out = tmp_path_factory.mktemp("reference") / "R"
    assert main([*FLIGHT, "--lockstep", "--out", str(out)]) == 0
    return digest(out)


def begin(tmp_path: Path, *command: str, line: tuple[str, ...] = LINE) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*line, *command], cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )


def wait_for(what: Callable[[], object], run: subprocess.Popen[str]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not what():
        assert run.poll() is None and time.monotonic() < until, "it did not come to it"
        time.sleep(0.02)


def ended(out: Path) -> int:
    """Return the number of episodes that have ended, by the journal so far."""
    journal = RunFolder(out).existing_journal()
    if journal is None:
        return 0
    ends = [e.message.episode for e in Log(journal).entries(["/tmc/episode"]) if e.message.phase == "end"]
    return max(ends, default=0)


def records(out: Path) -> int:
    journal = journal_in(out)
    return 0 if journal is None else sum(raw.topic.endswith("/record") for raw in Log(journal).raw())


def kill_all(run: subprocess.Popen[str], running: Running, out: Path) -> None:
    """Kill the supervisor first, so that it restarts no process; then all of its processes that still run."""
    run.kill()
    for pid in running(str(out)):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    run.communicate(timeout=PATIENCE_S)
    until = time.monotonic() + PATIENCE_S
    while running(str(out)) and time.monotonic() < until:
        time.sleep(0.02)


def test_a_tmc_killed_at_five_random_ticks_flies_the_same(
    running: Running, reference_digest: str, tmp_path: Path
) -> None:
    out, draw, kills = tmp_path / "R", random.Random(5), 0
    with begin(tmp_path, *FLIGHT, "--out", str(out), line=SLOW) as run:
        while kills < 5:
            before = records(out)
            wait_for(lambda before=before: records(out) > before, run)
            time.sleep(draw.uniform(0.0, 0.4))
            found = [pid for pid in running("-m tmc --config") if pid in running(str(out))]
            assert len(found) == 1 and run.poll() is None
            os.kill(found[0], signal.SIGKILL)
            kills += 1
            wait_for(lambda pid=found[0]: pid not in running(str(out)), run)
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors
    assert errors.count("tmc was killed by SIGKILL; it is started again") == 5
    assert digest(out) == reference_digest and check(out).good
    said = [e.message.message for e in Log(out / "tmc.mcap").entries(["/log"])]
    assert sum("the TMC was started again and goes on from tick" in text for text in said) == 5


def test_a_flight_goes_on_after_everything_was_killed(
    overfly: Overfly, here: Overfly, running: Running, reference_digest: str, tmp_path: Path
) -> None:
    out = tmp_path / "R"
    with begin(tmp_path, *FLIGHT, "--out", str(out), line=SLOW) as run:
        wait_for(lambda: records(out) > 40, run)
        busy = here("run", "--resume", out)
        assert busy.returncode == 2 and "is being written by another process: end that one first" in busy.stderr
        kill_all(run, running, out)
    assert 40 < records(out) < 3 * 51 and not RunFolder(out).journal.exists()
    again = overfly("run", "--resume", out, "--no-pictures")
    assert again.returncode == 0, again.stderr
    assert "Uncertainty" in again.stdout
    assert digest(out) == reference_digest and check(out).good
    told = json.loads((out / "run.json").read_text())
    assert set(told["exit_codes"].values()) == {0} and told["compacted"]["after"] > 0
    # Finished now: nothing is flown again, and the summary is said.
    size = (out / "tmc.mcap").stat()
    done = here("run", "--resume", out, "--json", "--no-pictures")
    assert done.returncode == 0 and json.loads(done.stdout)
    assert (out / "tmc.mcap").stat() == size


@pytest.mark.parametrize("priority", ["0", "0.6"])
def test_training_goes_on_after_everything_was_killed(
    overfly: Overfly, running: Running, tmp_path: Path, priority: str
) -> None:
    out = tmp_path / "R"
    small = ("--actors", "2", "--ticks", "60", "--episodes", "4", "--set", "replay.learn_start=60")
    small = (*small, "--set", f"replay.priority_exponent={priority}")
    small = (
        *small,
        "--set",
        "dqn.batch_size=16",
        "--set",
        "training.checkpoint_every=20",
        "--set",
        "replay.error_buffer=20",
    )
    with begin(tmp_path, "run", "patrol", *small, "--out", str(out)) as run:
        wait_for(lambda: ended(out) >= 1 and list((out / "checkpoints").glob("*.safetensors")), run)
        kill_all(run, running, out)
    before = ended(out)
    again = overfly("run", "--resume", out, "--no-pictures")
    assert again.returncode == 0, again.stderr
    assert 1 <= before <= ended(out) == 4
    entries = [e.message for e in Log(out / "tmc.mcap").entries(["/tmc/episode"])]
    assert [(e.episode, e.phase) for e in entries] == [(n, p) for n in range(1, 5) for p in ("begin", "end")]
    # 240 ticks; learning starts once 60 transitions are in, which is when some of the first 40 ticks are final.
    policies = [e.message for e in Log(out / "tmc.mcap").entries(["/learner/policy"])]
    assert 200 <= policies[-1].updates < 240 and [p.version for p in policies] == sorted(p.version for p in policies)
    assert check(out).good


def test_a_run_that_cannot_be_resumed_gives_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty, anomalies = tmp_path / "empty", tmp_path / "anomalies"
    empty.mkdir()
    anomalies.mkdir()
    LogWriter(anomalies / "tmc.mcap", "tmc", JournalConfig(), {}).close()
    for command, sentence in (
        (("run", "--resume", empty), "holds no journal (tmc.mcap): --resume takes the folder of a run that was begun"),
        (("tmc", "--resume", empty), "holds no journal (tmc.mcap)"),
        (("run", "--resume", tmp_path / "gone"), "holds no journal (tmc.mcap)"),
        (("run", "--resume", anomalies), "has no config.json, and its log holds none either"),
        (
            ("run", "quick", "--resume", anomalies),
            "with its own settings, as processes: give it nothing but --json, --no-pictures",
        ),
        (("run", "--resume", anomalies, "--ticks", 5), "give it nothing but --json"),
        (("tmc", "--resume", anomalies, "--ticks", 5), "give it nothing but --bind"),
        (("run",), "which preset?"),
    ):
        assert main([str(word) for word in command]) == 2
        said = capsys.readouterr()
        assert sentence in said.err and len(said.err.splitlines()) == 1 and said.out == ""
    assert list(empty.iterdir()) == []


def test_a_training_in_lock_step_cannot_be_resumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It leaves no checkpoint, so a learner that resumed it would start with random weights."""
    out, small = tmp_path / "R", ("--ticks", "40", "--episodes", "2", "--set", "replay.learn_start=30", "--no-pictures")
    assert main(["run", "quick", "--lockstep", "--set", "dqn.batch_size=8", *small, "--out", str(out)]) == 0
    policy = (out / "policies" / "final.onnx").read_bytes()
    assert "one, in lock step" in capsys.readouterr().out
    assert main(["run", "--resume", str(out), "--no-pictures"]) == 0  # it is over: only analyzed again
    (out / "run.json").unlink()  # as if it was interrupted
    assert main(["run", "--resume", str(out)]) == 2
    assert "was trained in lock step, which leaves no checkpoint to go on from" in capsys.readouterr().err
    assert (out / "policies" / "final.onnx").read_bytes() == policy
    last = [e.message for e in Log(out / "tmc.mcap").entries(["/learner/policy"])][-1]
    assert last.model == policy and last.updates == 60  # of 80 ticks; at tick 20, 30 transitions are in


def test_a_run_goes_on_over_its_own_copy_of_the_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Even if the file that it was started with has changed or is gone; but not if the run's copy was edited."""
    town, out = tmp_path / "town.txt", tmp_path / "R"
    town.write_text("#####\n#...#\n#####\n")
    fly = ("fly", "planner:greedy", "--lockstep", "--actors", "2", "--ticks", "20", "--map", str(town), "--no-pictures")
    assert main([*fly, "--out", str(out)]) == 0
    flown, copy = digest(out), (out / "map.txt").read_text()
    (out / "run.json").unlink()
    (out / "map.txt").write_text(copy.replace("...", ".#."))
    assert main(["run", "--resume", str(out)]) == 2
    assert f"the map {out / 'map.txt'} has changed since the run was begun" in capsys.readouterr().err
    (out / "map.txt").write_text(copy)
    town.unlink()
    assert main(["run", "--resume", str(out), "--no-pictures"]) == 0
    assert digest(out) == flown and (out / "map.txt").read_text() == copy


def test_the_first_command_of_a_run_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "R"
    assert main(["fly", "planner:greedy", "--lockstep", "--ticks", "20", "--no-pictures", "--out", str(out)]) == 0
    told = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(told | {"exit_codes": {}, "command": "overfly fly planner:greedy"}))
    assert main(["run", "--resume", str(out), "--no-pictures"]) == 0
    again = json.loads((out / "run.json").read_text())
    assert again["command"] == "overfly fly planner:greedy" and len(again["resumed"]) == 1


def test_an_empty_config_does_not_prevent_a_resume(tmp_path: Path) -> None:
    """A power cut may leave an empty file; the journal has a copy of the settings."""
    out = tmp_path / "R"
    assert main(["fly", "planner:greedy", "--lockstep", "--ticks", "60", "--no-pictures", "--out", str(out)]) == 0
    flown = digest(out)
    (out / "config.json").write_text("")
    (out / "run.json").unlink()
    assert main(["run", "--resume", str(out), "--no-pictures"]) == 0
    assert digest(out) == flown and json.loads((out / "config.json").read_text())["training.ticks"] == 60


def test_a_damaged_journal_is_resumed_and_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One bit of a record's length is flipped: the file seems to be cut there, but continues."""
    out = tmp_path / "R"
    short = ("--lockstep", "--ticks", "60", "--episodes", "4", "--no-pictures")
    assert main(["fly", "planner:greedy", *short, "--out", str(out)]) == 0
    with (out / "tmc.mcap").open("rb") as file:
        chunks = [at for at, opcode, _ in strict.records(file) if opcode == Opcode.CHUNK]
    data = bytearray((out / "tmc.mcap").read_bytes())
    data[chunks[0] + 5] ^= 1
    (out / "tmc.mcap").unlink()
    (out / "tmc.mcap.active").write_bytes(data)
    (out / "run.json").unlink()
    assert main(["log", "check", str(out)]) == 1
    capsys.readouterr()
    assert main(["run", "--resume", str(out), "--no-pictures"]) == 0
    said = capsys.readouterr().err
    assert "the run goes on from before that; the damaged file is kept as tmc.mcap.active.damaged-*" in said
    assert (out / "tmc.mcap.active.damaged-1").read_bytes() == bytes(data) and check(out).good
