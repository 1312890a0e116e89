"""The learner's process: what it refuses before it touches its folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from learner.checkpoint import CheckpointError
from learner.service import Service
from tmc.kernel.config import build, flat
from tmc.kernel.world import World
from tmc.wire import messages as m
from tmc.wire.sockets import EndpointError


def test_a_map_that_is_not_the_tmcs_is_refused(tmp_path: Path) -> None:
    """Of the same name and size: it would draw its observations over another town."""
    service = Service(f"ipc://{tmp_path}/sync", tmp_path / "R")
    welcome = m.Welcome(json.dumps(flat(build({}))), "another", "run", "", 0, 0)
    try:
        with pytest.raises(EndpointError, match="not the one that the TMC flies: copy it"):
            service._prepare(welcome, None)
    finally:
        service.close()
    assert not (tmp_path / "R").exists()


def test_a_welcome_to_another_mission_ends_the_learner(tmp_path: Path) -> None:
    """A TMC that was started anew on the same port: what was learned here is not that mission's."""
    service = Service(f"ipc://{tmp_path}/sync", tmp_path / "R")
    config = build({"network.channels": (2, 2), "network.dense": 2})
    world = World(config)
    first, other = (m.Welcome(json.dumps(flat(config)), world.map.fingerprint, run, "", 0, 0) for run in ("a", "b"))
    try:
        service._prepare(first, None)
        with pytest.raises(EndpointError, match="another mission runs here now"):
            service._obey(other)
        assert not service._obey(first)
    finally:
        service.close()


def test_damaged_checkpoints_are_not_passed_over_for_new_weights(tmp_path: Path) -> None:
    """What was learned would be gone without a word, and the team flies on by what is not trained."""
    folder = tmp_path / "R" / "checkpoints"
    folder.mkdir(parents=True)
    (folder / "checkpoint-7.safetensors").write_bytes(b"not a checkpoint")
    service = Service(f"ipc://{tmp_path}/sync", tmp_path / "R")
    try:
        with pytest.raises(CheckpointError, match=r"no checkpoint in .* is sound: remove them all"):
            service.learn(lambda: False)
    finally:
        service.close()
