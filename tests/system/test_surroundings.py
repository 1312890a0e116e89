"""What a command inherits from a parent, a shell or a terminal: ignored signals, closed streams, a locale, files."""

from __future__ import annotations

import ctypes
import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.command import LINE
from tmc.record.queries import digest

FLY = ("fly", "planner:greedy", "--actors", "2", "--ticks", "300", "--no-pictures")
LONG = ("fly", "planner:greedy", "--actors", "2", "--ticks", "60000", "--episodes", "50", "--no-pictures")
PATIENCE_S = 90.0


Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Return a function that starts `overfly ARGS`; end the processes that a failed test left.

    `before` is called in the new process, like a parent's setup. `line`: another command than `overfly`.
    """
    started: list[subprocess.Popen[str]] = []

    def begin(*args: object, before: Callable[[], Any] | None = None, **more: Any) -> subprocess.Popen[str]:
        started.append(popen(tmp_path, *args, before=before, **more))
        return started[-1]

    yield begin
    for process in started:
        if process.poll() is None:
            process.kill()
            process.wait()


def popen(folder: Path, *args: object, before: Callable[[], Any] | None, **more: Any) -> subprocess.Popen[str]:
    more = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **more}
    return subprocess.Popen([*LINE, *map(str, args)], cwd=folder, errors="replace", preexec_fn=before, **more)  # noqa: PLW1509  no threads


def until(true: Callable[[], Any], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, f"{what}: it did not happen"
        time.sleep(0.02)


def ignore(*numbers: int) -> Callable[[], None]:
    """Act as a parent that ignores these signals."""
    return lambda: [signal.signal(number, signal.SIG_IGN) for number in numbers] and None


def state(pid: int) -> str:
    """Return the letter of a process's state; "" when it has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def flies(out: Path) -> bool:
    """Return whether the first UAV of a run has started its log."""
    return (out / "uav-000.mcap.active").exists() or (out / "uav-000.mcap").exists()


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_the_parent_ignores_ends_nothing(start, tmp_path: Path, number: signal.Signals) -> None:
    """As with nohup, or in a script's background job. The processes of the mission still end in order."""
    out = tmp_path / "R"
    run = start(*FLY, "--ticks", 1500, "--out", out, before=ignore(number))
    until(lambda: flies(out), "the flight")
    run.send_signal(number)
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors
    assert set(json.loads((out / "run.json").read_text())["exit_codes"].values()) == {0}


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT])
@pytest.mark.parametrize("command", [("evaluate", "planner:greedy", "--seeds", "40", "--jobs", "2"), ("tmc",)])
def test_every_command_respects_it(start, tmp_path: Path, command: tuple[str, ...], number: signal.Signals) -> None:
    bind = ("--bind", f"ipc://{tmp_path}/s", "--out", tmp_path / "R") if command == ("tmc",) else ()
    run = start(*command, *bind, before=ignore(number))
    until(lambda: caught(run.pid, signal.SIGTERM), "handlers")
    run.send_signal(number)
    run.send_signal(number)
    time.sleep(0.3)
    assert run.poll() in {None, 0}
    run.send_signal(signal.SIGTERM)
    run.communicate(timeout=PATIENCE_S)
    assert run.returncode in {143, 0}


def caught(pid: int, number: int) -> bool:
    """Return whether a process has a handler for a signal."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return bool(int(next(line.split()[1] for line in lines if line.startswith("SigCgt:")), 16) >> (number - 1) & 1)


def test_a_parent_that_ignores_the_end_of_its_children(start, tmp_path: Path) -> None:
    """With SIGCHLD ignored, the system does not keep how a child ended."""
    out = tmp_path / "R"
    run = start(*FLY, "--out", out, before=ignore(signal.SIGCHLD))
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors
    told = json.loads((out / "run.json").read_text())
    assert told["exit_codes"] == {"tmc": 0, "uav-000": 0, "uav-001": 0} and told["restarts"] == {}


def test_a_mask_that_the_parent_left_is_taken_off(start, tmp_path: Path) -> None:
    def block() -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGCHLD, signal.SIGHUP, signal.SIGINT})

    out = tmp_path / "R"
    run = start(*LONG, "--out", out, before=block)
    until(lambda: flies(out), "the flight")
    run.send_signal(signal.SIGTERM)
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 143, errors


def test_a_terminal_that_closes_ends_the_mission_in_order(start, tmp_path: Path) -> None:
    """After SIGHUP no sentence can be written any more, but how each process ended is on the disk."""
    out = tmp_path / "R"
    ours, its = pty.openpty()
    run = start(*LONG, "--out", out, stdin=its, stdout=its, stderr=its, start_new_session=True)
    os.close(its)
    until(lambda: flies(out), "the flight")
    os.close(ours)
    run.send_signal(signal.SIGHUP)
    assert run.wait(PATIENCE_S) == 129
    assert {"tmc", "uav-000", "uav-001"} == set(json.loads((out / "run.json").read_text())["exit_codes"])


@pytest.mark.parametrize("stream", [1, 2])
def test_a_closed_stream_does_not_fail_the_work(start, tmp_path: Path, stream: int) -> None:
    out = tmp_path / "R"
    given = {1: "stdout", 2: "stderr"}[stream]
    run = start(*FLY, "--out", out, before=lambda: os.close(stream), **{given: None})
    printed, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors
    assert set(json.loads((out / "run.json").read_text())["exit_codes"].values()) == {0}
    assert stream == 1 or "Uncertainty" in printed


@pytest.mark.parametrize("mission", [FLY, ("evaluate", "planner:greedy", "--seeds", "2", "--ticks", "50")])
def test_a_full_stderr_does_not_fail_the_work(start, tmp_path: Path, mission: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        run = start(*mission, stderr=full)
        printed, _ = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0 and "ncertainty" in printed


def test_a_full_stdout_is_one_sentence_after_the_work(start, tmp_path: Path) -> None:
    out = tmp_path / "R"
    with Path("/dev/full").open("w") as full:
        run = start(*FLY, "--out", out, stdout=full)
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1
    assert errors.endswith("overfly: output: No space left on device\n") and "Traceback" not in errors
    assert (out / "summary.json").is_file()


@pytest.mark.parametrize(
    "command",
    [("map", "show"), ("doctor", "--settings"), ("evaluate", "planner:greedy", "--seeds", "2", "--ticks", "20"), FLY],
    ids=lambda command: command[0],
)
@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_locale_that_lacks_characters(start, tmp_path: Path, command: tuple[str, ...], encoding: str) -> None:
    env = os.environ | {"LC_ALL": "C", "PYTHONIOENCODING": encoding}
    if sys.prefix.isascii():  # else Python itself cannot start without UTF-8
        env |= {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    run = start(*command, env=env)
    printed, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors
    assert "Traceback" not in errors and printed


def test_files_are_read_and_written_in_utf_8_whatever_the_locale(start, tmp_path: Path) -> None:
    """With an option, Python warns wherever a file is opened in the encoding of the locale."""
    env = os.environ | {"PYTHONWARNDEFAULTENCODING": "1", "PYTHONWARNINGS": "error::EncodingWarning"}
    run = start(*FLY, "--ticks", "20", "--out", tmp_path / "R", env=env)
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors + "".join(p.read_text() for p in (tmp_path / "R" / "logs").iterdir())


SHADOWS = ("types", "signal", "multiprocessing", "numpy", "tmc", "random", "struct")


@pytest.mark.parametrize(
    "command", [("evaluate", "planner:greedy", "--seeds", "3", "--ticks", "20", "--jobs", "2"), FLY], ids=lambda c: c[0]
)
def test_nothing_is_imported_from_the_current_folder(start, tmp_path: Path, command: tuple[str, ...]) -> None:
    for name in SHADOWS:
        (tmp_path / f"{name}.py").write_text("raise SystemExit('imported from the current folder')\n")
    run = start(*command)
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors


def test_an_evaluation_whose_worker_is_killed_says_so(start, running, tmp_path: Path) -> None:
    run = start("evaluate", "planner:greedy", "--seeds", "4000", "--jobs", "2")
    marker = f"--parent={run.pid}"
    until(lambda: len(running(marker)) == 2, "two workers")
    os.kill(running(marker)[0], signal.SIGKILL)
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1
    assert errors.splitlines()[-1] == (
        "overfly: a worker process was killed by SIGKILL: memory may have run out, so try again with fewer --jobs"
    )
    assert "Traceback" not in errors and running(marker) == []


def test_workers_die_with_an_evaluation_that_is_killed(start, running, tmp_path: Path) -> None:
    run = start("evaluate", "planner:greedy", "--seeds", "4000", "--jobs", "2")
    marker = f"--parent={run.pid}"
    until(lambda: len(running(marker)) == 2, "two workers")
    run.kill()
    run.communicate()
    until(lambda: running(marker) == [], "no workers")


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.3, 0.8])
def test_ctrl_c_early_leaves_no_traceback(start, running, tmp_path: Path, delay: float) -> None:
    """The whole process group gets the signal, as from a terminal."""
    command = ("evaluate", "planner:greedy", "--seeds", "4000", "--jobs", "2")
    run = start(*command, start_new_session=True)
    until(lambda: caught(run.pid, signal.SIGINT), "the start of Python, which prints a traceback of its own before it")
    until(lambda: not caught(run.pid, signal.SIGINT), "the start of the command")
    time.sleep(delay)
    os.killpg(run.pid, signal.SIGINT)
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode in {130, -signal.SIGINT} and "Traceback" not in errors
    until(lambda: running(f"--parent={run.pid}") == [], "no workers")


def test_ctrl_z_stops_the_mission_and_fg_lets_it_go_on(start, here, running, tmp_path: Path) -> None:
    out, mission = tmp_path / "R", (*FLY, "--ticks", 3000, "--seed", 5)
    run = start(*mission, "--out", out, process_group=0)
    until(lambda: flies(out), "the flight")
    run.send_signal(signal.SIGTSTP)
    until(lambda: state(run.pid) in {"T", "Z"}, "the supervisor's stop")
    if state(run.pid) == "T":  # else it was over before
        others = set(running(str(out))) - {run.pid}
        until(lambda: {state(pid) for pid in others} <= {"T", ""}, "the stop of all others")
        run.send_signal(signal.SIGCONT)
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, errors
    assert here(*mission, "--lockstep", "--out", tmp_path / "L").returncode == 0
    assert digest(out) == digest(tmp_path / "L")


PR_SET_CHILD_SUBREAPER = 36
"""Code that makes a process adopt orphans, as process 1 does in a container."""


def test_the_first_process_of_a_container_reaps_what_a_killed_forkserver_leaves(start, running, tmp_path: Path) -> None:
    out = tmp_path / "R"
    run = start(*LONG, "--out", out, before=lambda: ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1))

    def uavs() -> bool:
        return len(set(running("actors --id")) & set(running(str(out)))) == 2

    for _ in range(3):
        until(uavs, "the UAVs")
        (server,) = set(running("forkserver")) & set(running(str(out)))
        os.kill(server, signal.SIGKILL)
        until(lambda server=server: state(server) == "", "its end")
    until(uavs, "the UAVs")
    until(lambda: zombies(run.pid) == [], "no zombies")
    run.send_signal(signal.SIGTERM)
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 143, errors


def zombies(parent: int) -> list[int]:
    """Return the children of a process that have not been waited for."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if fields[0] == "Z" and int(fields[1]) == parent:
            found.append(int(stat.parent.name))
    return found


def test_both_sides_name_what_they_wait_for(start, tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/s"
    tmc = start("tmc", "--fly", "planner:greedy", "--actors", 2, "--bind", endpoint, "--out", tmp_path / "R")
    uav = start("actor", "--id", 0, "--connect", endpoint, "--out", tmp_path / "U")
    try:
        for process, line in (
            (tmc, "note: the TMC waits for uav-001"),
            (uav, "note: UAV 0 waits; the mission waits for uav-001"),
        ):
            assert process.stderr is not None
            assert any(line in said for said in process.stderr)
    finally:
        for process in (uav, tmc):
            process.send_signal(signal.SIGTERM)
        for process in (uav, tmc):
            process.communicate(timeout=PATIENCE_S)


def test_a_refused_learner_does_not_delay_the_end(start, tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/s"
    tmc = start("tmc", "--fly", "planner:greedy", "--actors", 1, "--ticks", 50, "--bind", endpoint,
                "--out", tmp_path / "R")  # fmt: skip
    learner = start("learner", "--connect", endpoint, "--out", tmp_path / "L")
    _, errors = learner.communicate(timeout=PATIENCE_S)
    assert learner.returncode == 2 and "the TMC refused" in errors
    uav = start("actor", "--id", 0, "--connect", endpoint, "--out", tmp_path / "U")
    assert uav.wait(PATIENCE_S) == 0
    over = time.monotonic()
    uav.communicate()
    _, errors = tmc.communicate(timeout=PATIENCE_S)
    assert tmc.returncode == 0, errors
    assert "waits for learner to leave" not in errors and time.monotonic() - over < 30.0  # it would stay for 60 s
