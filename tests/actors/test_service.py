"""The UAV's process: what it does before it knows its mission."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import zmq

from actors.service import Left, Service
from tmc.wire import messages as m
from tmc.wire import process, sockets


def test_a_mission_that_is_over_sends_a_new_process_home(tmp_path: Path) -> None:
    endpoint, context = f"ipc://{tmp_path}/sync", zmq.Context[Any]()
    tmc, service = sockets.router(context, endpoint), Service(0, endpoint, tmp_path / "R")
    try:
        with ThreadPoolExecutor(1) as other:
            joining = other.submit(service._join, lambda: False)
            assert tmc.poll(20_000)
            frames = sockets.receive(tmc)
            assert frames is not None
            sockets.send(tmc, m.End("the mission is over"), bytes(frames[0]))
            with pytest.raises(Left, match="over") as left:
                joining.result(20)
            assert left.value.code == process.DONE
    finally:
        service.close()
        context.destroy(linger=0)
