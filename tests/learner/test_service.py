"""The learner's process: what it refuses before it writes to its folder, and how it greets a restarted TMC."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import zmq

from learner.checkpoint import CheckpointError
from learner.service import MAX_REQUESTS, ReplacedError, Service
from tests.command import PATIENCE_S
from tmc.kernel.config import build, flat
from tmc.kernel.world import World
from tmc.wire import messages as m
from tmc.wire import sockets
from tmc.wire.codec import decode
from tmc.wire.sockets import EndpointError

NOWHERE = "tcp://127.0.0.1:1"
"""Where no TMC ever is."""


def test_a_map_that_is_not_the_tmcs_is_refused(tmp_path: Path) -> None:
    """A map of the same name and size: the learner would draw its observations over another town."""
    service = Service(NOWHERE, tmp_path / "R")
    welcome = m.Welcome(json.dumps(flat(build({}))), "another", "run", "", 0, 0)
    try:
        with pytest.raises(EndpointError, match="not the one that the TMC flies: copy it"):
            service._prepare(welcome, None)
    finally:
        service.close()
    assert not (tmp_path / "R").exists()


def test_a_welcome_to_another_mission_ends_the_learner(tmp_path: Path) -> None:
    """A new TMC on the same port: what was learned here does not belong to its mission."""
    service = Service(NOWHERE, tmp_path / "R")
    config = build({"network.channels": (2, 2), "network.dense": 2})
    world = World(config)
    first, other = (m.Welcome(json.dumps(flat(config)), world.map.fingerprint, run, "", 0, 0) for run in ("a", "b"))
    try:
        service._prepare(first, None)
        with pytest.raises(EndpointError, match="another mission runs here now"):
            service._handle(other)
        assert not service._handle(first)
    finally:
        service.close()


def test_damaged_checkpoints_are_not_passed_over_for_new_weights(tmp_path: Path) -> None:
    """Otherwise what was learned would be lost silently, and the team would fly an untrained policy."""
    folder = tmp_path / "R" / "checkpoints"
    folder.mkdir(parents=True)
    (folder / "checkpoint-7.safetensors").write_bytes(b"not a checkpoint")
    service = Service(NOWHERE, tmp_path / "R")
    try:
        with pytest.raises(CheckpointError, match=r"no checkpoint in .* is intact: remove them all"):
            service.learn(lambda: False)
    finally:
        service.close()


def heard(tmc: zmq.Socket[Any], count: int) -> list[str]:
    """Return the kinds of the next `count` messages; assert that no more follow."""
    said = []
    while tmc.poll(200 if len(said) >= count else 1000 * PATIENCE_S):
        frames = sockets.receive(tmc)
        assert frames is not None
        said.append(type(decode(frames[1:])).__name__)
    return said


def test_however_often_a_tmc_is_away_the_same_number_of_requests_is_in_flight(tmp_path: Path, short: Path) -> None:
    """It finds several hellos when it is back, and welcomes each."""
    tmc = sockets.router(context := zmq.Context(), f"ipc://{short}/sync.learner")
    service = Service(f"ipc://{short}/sync", tmp_path / "R")
    config = build({"network.channels": (2, 2), "network.dense": 2})
    welcome = m.Welcome(json.dumps(flat(config)), World(config).map.fingerprint, "run", "", 0, 0)

    try:
        service._prepare(welcome, None)
        service._publish()
        service._request_minibatches()
        assert heard(tmc, 1 + MAX_REQUESTS) == ["PolicyPush", *["SampleRequest"] * MAX_REQUESTS]
        service._hello_sent = True  # after a second of silence, and another one
        for _ in range(3):
            service._handle(welcome)
        assert heard(tmc, 1 + MAX_REQUESTS) == ["PolicyPush", *["SampleRequest"] * MAX_REQUESTS]
        assert len(service._in_flight) == MAX_REQUESTS
    finally:
        service.close()
        tmc.close()
        context.destroy(0)


def test_a_learner_leaves_when_a_newer_one_has_its_place(tmp_path: Path) -> None:
    service = Service(NOWHERE, tmp_path / "R")
    try:
        assert not service._handle(m.Error("fenced", "a newer process is the learner: leave", service.incarnation + 1))
        with pytest.raises(ReplacedError, match="a newer process is the learner"):
            service._handle(m.Error("fenced", "a newer process is the learner: leave", service.incarnation))
    finally:
        service.close()
