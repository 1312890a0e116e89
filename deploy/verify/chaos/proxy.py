"""A proxy between the TMC and its clients that a trial can cut: it forwards bytes before each endpoint."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from random import Random

from deploy.run.plan import Plan
from tmc.wire.sockets import learner_endpoint

CHUNK_BYTES = 65_536
"""Most bytes that are forwarded at once."""
IPC = "ipc://"

Pair = tuple[socket.socket, socket.socket]


class Forwarder:
    """Forwards bytes between clients of the socket path `front` and the socket path `back`, both ways, in threads."""

    def __init__(self, front: Path, back: Path) -> None:
        self.note_recovery = back
        self._pairs: set[Pair] = set()
        self._lock, self._closed_until = threading.Lock(), 0.0
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(front))
        self._listener.listen(1024)
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):  # closed
            while True:
                client, _ = self._listener.accept()
                self._connect(client)

    def _connect(self, client: socket.socket) -> None:
        server = socket.socket(socket.AF_UNIX)
        if time.monotonic() < self._closed_until or server.connect_ex(str(self.note_recovery)):
            client.close()
            server.close()
            return
        pair = client, server
        with self._lock:
            self._pairs.add(pair)
        for one, other in (pair, pair[::-1]):
            threading.Thread(target=self._forward, args=(pair, one, other), daemon=True).start()

    def _forward(self, pair: Pair, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(CHUNK_BYTES):
                sink.sendall(data)
        self._drop(pair)

    def _drop(self, pair: Pair) -> None:
        """Close both sides, which wakes the threads that wait for them."""
        with self._lock:
            self._pairs.discard(pair)
        for sock in pair:
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
            sock.close()

    def cut(self, seconds: float, draw: Random) -> None:
        """Drop some connections, or all, and refuse new ones for `seconds`."""
        self._closed_until = time.monotonic() + seconds
        share = draw.choice((0.5, 1.0))
        with self._lock:
            pairs = [pair for pair in self._pairs if draw.random() < share]
        for pair in pairs:
            self._drop(pair)

    def close(self) -> None:
        """Drop all connections and stop listening."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._closed_until = math.inf
        with self._lock:
            pairs = [*self._pairs]
        for pair in pairs:
            self._drop(pair)


class CuttableProxy:
    """A forwarder before each endpoint of a plan. `plan`: the same plan, in which clients connect to the forwarders."""

    def __init__(self, plan: Plan) -> None:
        ends = [plan.endpoint, learner_endpoint(plan.endpoint)]
        near = f"{IPC}{plan.scratch}/near"
        fronts = [near, learner_endpoint(near)]
        self.forwarders = [Forwarder(_path(front), _path(end)) for front, end in zip(fronts, ends, strict=True)]
        children = tuple(replace(child, command=_redirected(child.command, near)) for child in plan.children)
        self.plan = replace(plan, children=children)

    def cut(self, seconds: float, draw: float) -> None:
        """Cut connections of UAVs and of the learner."""
        for forwarder in self.forwarders:
            forwarder.cut(seconds, Random(draw))

    def close(self) -> None:
        """Close both forwarders."""
        for forwarder in self.forwarders:
            forwarder.close()


def _path(endpoint: str) -> Path:
    return Path(endpoint.removeprefix(IPC))


def _redirected(command: Sequence[str], endpoint: str) -> tuple[str, ...]:
    """Return the command with another endpoint to connect to."""
    return tuple(
        endpoint if before == "--connect" else word for before, word in zip(("", *command), command, strict=False)
    )
