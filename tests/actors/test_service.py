"""The UAV's process, before it knows its mission and while it waits."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from actors.service import FlightEnded, Service, belongs_to_another_run
from tests.command import PATIENCE_S
from tmc.kernel.config import JournalConfig, build, flat
from tmc.kernel.world import World
from tmc.record.writer import LogWriter
from tmc.wire import messages as m
from tmc.wire import process, sockets
from tmc.wire.codec import decode


def test_a_mission_that_is_over_ends_a_new_process(tmp_path: Path, short: Path) -> None:
    endpoint, context = f"ipc://{short}/sync", zmq.Context[Any]()
    tmc, service = sockets.router(context, endpoint), Service(0, endpoint, tmp_path / "R")
    try:
        with ThreadPoolExecutor(1) as other:
            joining = other.submit(service._join, lambda: False)
            assert tmc.poll(1000 * PATIENCE_S)
            frames = sockets.receive(tmc)
            assert frames is not None
            sockets.send(tmc, m.End(reason="the mission is over"), bytes(frames[0]))
            with pytest.raises(FlightEnded, match="over") as left:
                joining.result(PATIENCE_S)
            assert left.value.code == process.DONE
    finally:
        service.close()
        context.destroy(linger=0)


def test_beacons_of_others_do_not_keep_a_uav_from_requesting_and_resending(tmp_path: Path, short: Path) -> None:
    """UAV 0 waits for UAV 1, which sends nothing, while beacons of UAV 2 keep arriving."""
    world = World(build({"team.size": 3, "team.controller": "planner:greedy", "training.ticks": 100}))
    numbered = ((e, world.starts(e)) for e in range(1, 5000))
    episode, starts = next((e, s) for e, s in numbered if world.grid.chebyshev(s[0], s[1]) <= 2)
    endpoint, context = f"ipc://{short}/sync", zmq.Context[Any]()
    tmc, service, over = sockets.router(context, endpoint), Service(0, endpoint, tmp_path / "R"), threading.Event()
    zeros = np.zeros(world.law.cells.size, "<u2")
    welcome = m.Welcome(
        config=json.dumps(flat(world.config)), map=world.map.fingerprint, run="run", tracks="", policy=0, sequence=0
    )
    begin = m.Begin(
        episode=episode,
        tick=0,
        shipped=-1,
        sequence=0,
        version=0,
        policy=0,
        last_visit=zeros,
        track=np.array(starts[:1], "<u2"),
        lost=m.EMPTY,
    )
    beacon = m.Beacon(uav=2, episode=episode, tick=1, cells=np.array(starts[2:], "<u2"), to=np.array([0], "<u2"))
    said: Counter[str] = Counter()
    try:
        with ThreadPoolExecutor(1) as other:
            flying, until = other.submit(service.fly, over.is_set), time.monotonic() + PATIENCE_S
            while (said["ask"] < 5 or said["Alive"] < 2) and time.monotonic() < until:
                if said["Hello"]:
                    sockets.send(tmc, beacon, b"uav-000")
                if not tmc.poll(5):
                    continue
                identity, *frames = sockets.receive(tmc) or []
                message = decode(frames)
                said[type(message).__name__] += 1
                said["ask"] += isinstance(message, m.Beacon) and message.ask >= 0
                if isinstance(message, m.Hello):
                    for answer in (welcome, begin):
                        sockets.send(tmc, answer, bytes(identity))
                elif isinstance(message, m.Record):
                    sockets.send(
                        tmc,
                        m.Map(
                            episode=episode,
                            tick=0,
                            version=1,
                            policy=0,
                            sequence=0,
                            acknowledged=0,
                            last_visit=zeros,
                            active=m.EMPTY,
                        ),
                        bytes(identity),
                    )
            over.set()
            with pytest.raises(FlightEnded):
                flying.result(PATIENCE_S)
        assert said["ask"] >= 5 and said["Alive"] >= 2, said
    finally:
        service.close()
        context.destroy(linger=0)


def test_the_log_of_another_mission_is_not_resumed(tmp_path: Path) -> None:
    path = tmp_path / "uav-000.mcap"
    assert not belongs_to_another_run(path, "a")
    LogWriter(path, "uav-000", JournalConfig(), {"run": "a"}).close()
    assert not belongs_to_another_run(path, "a") and belongs_to_another_run(path, "b")
    path.rename(tmp_path / "uav-000.mcap.active")
    assert belongs_to_another_run(path, "b")
