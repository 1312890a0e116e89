"""The learner's process: what it refuses before it touches its folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from learner.service import Service
from tmc.kernel.config import build, flat
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
