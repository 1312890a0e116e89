"""Three hosts with 20 ms and 2 % loss between them: UAVs there fly the cells that one process flies."""

from __future__ import annotations

import contextlib
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.command import LINE, PATIENCE_S
from tests.system.hosts import Hosts, hosts, why_not
from tmc.record.queries import digest
from tmc.record.reader import read

TEAM = ("--actors", 4, "--seed", 7)
WHERE = (1, 1, 2, 2)
"""The host of each UAV; the TMC is on host 0."""


@pytest.fixture(scope="module", autouse=True)
def _possible() -> None:
    reason = why_not()
    if reason:
        pytest.skip(reason)


@pytest.fixture
def three() -> Iterator[Hosts]:
    with hosts(3, delay=0.02, loss=0.02, seed=7) as made:
        yield made


@contextlib.contextmanager
def mission(net: Hosts, folder: Path, ticks: int) -> Iterator[list[subprocess.Popen[str]]]:
    """Start the TMC and the UAVs by hand, each on its host; end them with the block."""
    here = ("tmc", "--fly", "planner:greedy", *TEAM, "--ticks", ticks, "--bind", "tcp://0.0.0.0:5555")
    there = f"tcp://{net.address(0)}:5555"
    with contextlib.ExitStack() as undo:
        processes = [start(undo, folder, net, 0, *here, "--out", "R")]
        for uav, host in enumerate(WHERE):
            processes.append(start(undo, folder, net, host, "actor", "--id", uav, "--connect", there, "--out", "U"))
        yield processes


def start(undo: contextlib.ExitStack, folder: Path, net: Hosts, host: int, *args: object) -> subprocess.Popen[str]:
    # `ip netns exec` becomes the command that it is given, so the process is our child and kill() reaches it.
    command = net.on(host, *LINE, *args)
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    undo.enter_context(process)
    undo.callback(process.kill)
    return process


def assert_flown_as_in_one_process(here, processes: list[subprocess.Popen[str]], folder: Path, ticks: int) -> None:
    for process in (*processes[1:], processes[0]):
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
    alone = here("fly", "planner:greedy", *TEAM, "--ticks", ticks, "--lockstep", "--no-pictures", "--out", "L")
    assert alone.returncode == 0, alone.stderr
    assert digest(folder / "R") == digest(folder / "L")


def test_three_hosts_fly_what_one_process_flies(here, three: Hosts, tmp_path: Path) -> None:
    with mission(three, tmp_path, 200) as processes:
        assert_flown_as_in_one_process(here, processes, tmp_path, 200)
    assert three.switch.passed > 1000 and three.switch.lost > 10


def test_a_host_that_is_cut_off_in_flight_and_comes_back_changes_nothing(here, three: Hosts, tmp_path: Path) -> None:
    """5 s is longer than the sockets' heartbeats allow: connections drop, and messages in transit are lost."""
    with mission(three, tmp_path, 150) as processes:
        until_flown(tmp_path / "U" / "uav-003.mcap.active", uav=3, tick=50)
        with three.cut(2):
            time.sleep(5)
            assert [process.poll() for process in processes] == [None] * 5
        assert three.switch.severed > 10
        assert_flown_as_in_one_process(here, processes, tmp_path, 150)


def until_flown(log: Path, uav: int, tick: int) -> None:
    """Wait until a UAV has reached a tick, by its log."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        if log.exists() and any(status.message.tick >= tick for status in read(log, [f"/uav/{uav}/status"])):
            return
        time.sleep(0.1)
    raise AssertionError(f"UAV {uav} did not reach tick {tick}")
