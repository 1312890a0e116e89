"""Around a main loop, with real processes: die with the parent, note signals, and end with a code that tells."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tmc.wire import process
from tmc.wire.process import DONE, FAILED, FENCED, USAGE, die_with_parent, run

PATIENCE_S = 100.0
ROOT = Path(process.__file__).parents[2]
CHILD = """
import os, sys, time
from tmc.wire.process import die_with_parent
die_with_parent(int(sys.argv[1]) if sys.argv[1] != "parent" else os.getppid())
print(os.getpid(), flush=True)
time.sleep(60)
"""
PARENT = """
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-P", "-c", sys.argv[1], str(os.getpid())])
time.sleep(60)
"""
LOOP = """
import time
from tmc.wire.process import Stop
stop = Stop()
print("ready", flush=True)
while not stop():
    time.sleep(0.01)
print("leaving in order", flush=True)
{after}
"""

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts Python processes on the project's code, and ends those that are left."""
    started: list[subprocess.Popen[str]] = []

    def begin(code: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-P", "-c", code, *arguments]
        child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(child)
        return child

    yield begin
    for child in started:
        child.kill()
        child.communicate()


def line(child: subprocess.Popen[str]) -> str:
    """The next line that a process prints."""
    assert child.stdout is not None
    assert select.select([child.stdout], [], [], PATIENCE_S)[0], "it says nothing"
    return child.stdout.readline().strip()


def ended(pid: int, within: float) -> bool:
    """Whether a process ends in time; -1 stands for one that is not there any more."""
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([handle], [], [], within)[0])
    finally:
        os.close(handle)


@pytest.mark.skipif(sys.platform != "linux", reason="the parent-death signal is Linux's")
def test_a_child_dies_when_its_parent_is_killed(start: Start) -> None:
    parent = start(PARENT, CHILD)
    child = int(line(parent))
    try:
        assert not ended(child, 0.1)
        parent.send_signal(signal.SIGKILL)
        assert ended(child, PATIENCE_S)
    finally:
        if not ended(child, 0):
            os.kill(child, signal.SIGKILL)


@pytest.mark.skipif(sys.platform != "linux", reason="the parent-death signal is Linux's")
def test_a_child_without_it_is_orphaned(start: Start) -> None:
    """The control that shows that the test above can fail."""
    parent = start(PARENT, CHILD.replace("die_with_parent(int", "(int"))
    child = int(line(parent))
    try:
        parent.send_signal(signal.SIGKILL)
        parent.wait(PATIENCE_S)
        assert not ended(child, 0.3)
    finally:
        os.kill(child, signal.SIGKILL)


def test_a_child_whose_parent_is_dead_already_leaves_at_once(start: Start) -> None:
    """The parent died between the fork and the call: its id is no longer the one of the parent."""
    gone = start("pass")
    gone.wait(PATIENCE_S)
    late = start(CHILD, str(gone.pid))
    assert late.wait(PATIENCE_S) == FAILED
    assert late.stdout is not None
    assert late.stdout.read() == ""


def test_a_child_of_its_parent_goes_on(start: Start) -> None:
    child = start(CHILD, str(os.getpid()))
    assert int(line(child)) == child.pid
    assert child.poll() is None


def test_no_parent_means_nothing_to_do() -> None:
    die_with_parent(0)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_is_only_noted_and_the_loop_leaves_in_order(number: signal.Signals, start: Start) -> None:
    child = start(LOOP.format(after=""))
    assert line(child) == "ready"
    child.send_signal(number)
    assert line(child) == "leaving in order"
    assert child.wait(PATIENCE_S) == DONE


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_second_signal_ends_the_process_at_once(number: signal.Signals, start: Start) -> None:
    child = start(LOOP.format(after="time.sleep(60)"))
    assert line(child) == "ready"
    child.send_signal(signal.SIGTERM)
    assert line(child) == "leaving in order"
    child.send_signal(number)
    assert child.wait(PATIENCE_S) == 128 + number


class UserError(ValueError):
    """A user's mistake."""


def test_run_passes_the_exit_code_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(lambda: FENCED, (UserError,)) == FENCED
    assert capsys.readouterr() == ("", "")


def test_run_prints_one_sentence_for_a_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    def main() -> int:
        raise UserError("team.size = 0 is out of range: choose 1 to 1000")

    assert run(main, (UserError,)) == USAGE
    assert capsys.readouterr() == ("", "overfly: team.size = 0 is out of range: choose 1 to 1000\n")


def test_run_takes_a_subclass_of_a_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    def main() -> int:
        raise UserError("no")

    assert run(main, (OSError, ValueError)) == USAGE
    assert capsys.readouterr().err == "overfly: no\n"


def test_run_does_not_hide_a_fault_of_ours() -> None:
    def main() -> int:
        raise KeyError("a bug")

    with pytest.raises(KeyError):
        run(main, (UserError,))


def test_a_mistake_in_a_process_is_exit_code_2_without_a_traceback(start: Start) -> None:
    code = (
        "import sys\nfrom tmc.kernel.config import ConfigError, build\nfrom tmc.wire.process import run\n"
        "sys.exit(run(lambda: build({'team.size': 0}) and 0, (ConfigError,)))"
    )
    child = start(code)
    out, err = child.communicate(timeout=PATIENCE_S)
    assert (child.returncode, out) == (2, "")
    assert err == "overfly: team.size = 0 is out of range: choose 1 to 1,000\n"


def test_exit_codes_can_be_told_apart() -> None:
    codes = {name: value for name, value in vars(process).items() if name.isupper() and type(value) is int}
    codes = {name: value for name, value in codes.items() if not name.startswith("_")}
    assert (codes["DONE"], codes["FAILED"], codes["USAGE"], codes["FENCED"]) == (0, 1, 2, 75)
    assert len(set(codes.values())) == len(codes)
    assert all(0 <= code < 256 for code in codes.values())
