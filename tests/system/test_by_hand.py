"""The roles started by hand over tcp, as on several hosts: beacons instead of shared memory, the same cells flown."""

from __future__ import annotations

import subprocess
from pathlib import Path

import zmq

from tests.command import LINE, PATIENCE_S
from tmc.record.queries import digest
from tmc.wire import messages as m
from tmc.wire import sockets
from tmc.wire.codec import encode


def start(tmp_path: Path, *args: object) -> subprocess.Popen[str]:
    command = [*LINE, *map(str, args)]
    return subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def test_roles_by_hand_over_tcp_fly_the_same(here, tmp_path: Path) -> None:
    endpoint = f"tcp://127.0.0.1:{sockets.free_port()}"
    options = ("--actors", 4, "--ticks", 200, "--seed", 7)
    tmc = start(tmp_path, "tmc", "--fly", "planner:greedy", *options, "--bind", endpoint, "--out", tmp_path / "R")
    uavs = [start(tmp_path, "actor", "--id", i, "--connect", endpoint, "--out", tmp_path / "U") for i in range(4)]
    for process in (*uavs, tmc):
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
    alone = ("fly", "planner:greedy", *options, "--lockstep", "--no-pictures", "--out", tmp_path / "L")
    assert here(*alone).returncode == 0
    assert digest(tmp_path / "R") == digest(tmp_path / "L")


def test_a_learner_by_hand(tmp_path: Path) -> None:
    endpoint = f"tcp://127.0.0.1:{sockets.free_port()}"
    small = (
        "--actors",
        1,
        "--ticks",
        60,
        "--episodes",
        1,
        "--set",
        "replay.learn_start=20",
        "--set",
        "dqn.batch_size=8",
    )
    tmc = start(tmp_path, "tmc", "patrol", *small, "--bind", endpoint, "--out", tmp_path / "R")
    uav = start(tmp_path, "actor", "--id", 0, "--connect", endpoint, "--out", tmp_path / "U")
    learner = start(tmp_path, "learner", "--connect", endpoint, "--out", tmp_path / "L")
    for process in (uav, learner, tmc):
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
    assert (tmp_path / "L" / "policies" / "final.onnx").is_file()


def test_a_busy_port_is_one_sentence(tmp_path: Path) -> None:
    with zmq.Context() as context:
        port = sockets.free_port()
        taken = context.socket(zmq.ROUTER)
        taken.bind(f"tcp://127.0.0.1:{port}")
        tmc = start(tmp_path, "tmc", "--bind", f"tcp://127.0.0.1:{port}", "--out", tmp_path / "R")
        _, errors = tmc.communicate(timeout=PATIENCE_S)
        taken.close()
    assert tmc.returncode == 2
    assert errors.count("\n") == 1 and "free port" in errors


def test_hostile_frames_change_nothing(here, tmp_path: Path) -> None:
    """Malformed, foreign, oversize and out-of-range frames while a mission flies: counted, answered, survived."""
    endpoint = f"tcp://127.0.0.1:{sockets.free_port()}"
    options = ("--actors", 2, "--ticks", 300, "--seed", 3)
    tmc = start(tmp_path, "tmc", "--fly", "planner:greedy", *options, "--bind", endpoint, "--out", tmp_path / "R")
    good = [encode(m.StatusRequest())[0], encode(m.SampleRequest(request=1))[0], encode(m.PolicyRequest(version=99))[0]]
    bad = [b"", b"\xc1", b"x" * 100_000, b"\x81\xa1v\x02", good[0].replace(b"\x01", b"\x09"), b"\xdf\xff\xff\xff\xff"]
    with zmq.Context() as context:
        hostile = [sockets.dealer(context, endpoint, f"observer-{i}") for i in range(3)]
        replies = [0, 0, 0]
        hostile[0].send(good[0])
        assert hostile[0].poll(1000 * PATIENCE_S), "the TMC did not answer"
        for round_ in range(40):
            for sock in hostile:
                sock.send_multipart([bad[round_ % len(bad)], *[b"y"] * (round_ % 20)])
                sock.send(good[round_ % len(good)])
        uavs = [start(tmp_path, "actor", "--id", i, "--connect", endpoint, "--out", tmp_path / "U") for i in range(2)]
        for i, sock in enumerate(hostile):
            while replies[i] < 34 and sock.poll(1000 * PATIENCE_S):
                replies[i] += isinstance(sockets.receive_message(sock), m.Error)
            sock.close()
        for process in (*uavs, tmc):
            _, errors = process.communicate(timeout=PATIENCE_S)
            assert process.returncode == 0, errors
    assert sum(replies) >= 100
    alone = ("fly", "planner:greedy", *options, "--lockstep", "--no-pictures", "--out", tmp_path / "L")
    assert here(*alone).returncode == 0
    assert digest(tmp_path / "R") == digest(tmp_path / "L")
    notes = here("log", "cat", tmp_path / "R", "--topic", "/log").stdout
    assert notes.count("rejected a frame") >= 100
