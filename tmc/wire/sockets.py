"""The sockets: the TMC binds, everybody else connects. Only this module and the services know ZeroMQ.

Options follow what was measured (docs/architecture.md): no linger, since it hangs at exit; a bounded queue, since the
mark counts messages and not bytes; a limit on each part; heartbeats on the connecting side only, because a bound ROUTER
with heartbeats can be aborted by a peer that fills its mark and leaves.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zmq

from tmc.wire.codec import CodecError, decode, encode
from tmc.wire.fields import FRAME_LIMIT
from tmc.wire.messages import Message

PART_LIMIT = FRAME_LIMIT
"""Largest frame that a socket takes, bytes; the codec has tighter limits for the header."""
PARTS = 16
"""Most frames in a message."""
NAME = re.compile(rb"uav-[0-9]{3,5}|learner|observer-[0-9a-z-]{1,40}")
"""Addresses that a client may call itself."""


class EndpointError(ValueError):
    """An endpoint that cannot be used: one sentence with the mend."""


def feed_endpoint(sync: str) -> str:
    """The learner's endpoint, beside that of the UAVs: the next tcp port, or the same ipc path with `.feed`."""
    if sync.startswith("tcp://"):
        host, _, port = sync.rpartition(":")
        if re.fullmatch("[0-9]{1,5}", port) and 0 < int(port) < 65_535:
            return f"{host}:{int(port) + 1}"
    if sync.startswith("ipc://") and len(sync) > len("ipc://"):
        return f"{sync}.feed"
    raise EndpointError(f"'{sync}' is no endpoint: write tcp://HOST:PORT or ipc://PATH")


def free_port() -> int:
    """A tcp port that is free on this machine, and whose successor is free too."""
    while True:
        with socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port: int = first.getsockname()[1]
            try:
                second.bind(("127.0.0.1", port + 1))
            except (OSError, OverflowError):
                continue
            return port


def check_free(endpoint: str) -> None:
    """Raise EndpointError unless both endpoints of a TMC can be bound here and now."""
    with zmq.Context() as context:
        for one in (endpoint, feed_endpoint(endpoint)):
            router(context, one).close()


def router(context: zmq.Context[Any], endpoint: str, queue: int = 32) -> zmq.Socket[Any]:
    """A bound ROUTER. A client that comes back takes over its name; a message to nobody raises."""
    _check_endpoint(endpoint)
    sock: zmq.Socket[Any] = context.socket(zmq.ROUTER)
    sock.setsockopt(zmq.LINGER, 0)
    sock.setsockopt(zmq.RCVHWM, queue)
    sock.setsockopt(zmq.SNDHWM, 1000)
    sock.setsockopt(zmq.MAXMSGSIZE, PART_LIMIT)
    sock.setsockopt(zmq.ROUTER_HANDOVER, 1)
    sock.setsockopt(zmq.ROUTER_MANDATORY, 1)
    try:
        sock.bind(endpoint)
    except zmq.ZMQError as error:
        sock.close()
        raise EndpointError(f"cannot bind {endpoint}: {error.strerror or error}; choose a free port or path") from None
    return sock


def _check_endpoint(endpoint: str) -> None:
    """Refuse what ZeroMQ would do something surprising with: wrap a port round, or take a path from its owner."""
    if endpoint.startswith("tcp://"):
        port = endpoint.rpartition(":")[2]
        if not re.fullmatch("[0-9]{1,5}", port) or int(port) > 65_535:
            raise EndpointError(f"{endpoint} has no port from 1 to 65535: write tcp://HOST:PORT")
    path = Path(endpoint.removeprefix("ipc://"))
    if endpoint.startswith("ipc://") and path.exists():
        if path.is_file():
            raise EndpointError(f"{path} is a file that is no socket: choose another path")
        if path.is_socket() and _alive(endpoint):
            raise EndpointError(f"{endpoint} is in use by another process: choose another path")


def _alive(endpoint: str) -> bool:
    """True when somebody listens on an ipc path: ZeroMQ would take the path away from it without a word."""
    path = endpoint.removeprefix("ipc://")
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(path) == 0


def dealer(context: zmq.Context[Any], endpoint: str, name: str) -> zmq.Socket[Any]:
    """A DEALER that calls itself `name`, connected; ZeroMQ reconnects by itself."""
    sock: zmq.Socket[Any] = context.socket(zmq.DEALER)
    sock.setsockopt(zmq.LINGER, 0)
    sock.setsockopt(zmq.IDENTITY, name.encode())
    sock.setsockopt(zmq.MAXMSGSIZE, PART_LIMIT)
    sock.setsockopt(zmq.RECONNECT_IVL, 50)
    sock.setsockopt(zmq.RECONNECT_IVL_MAX, 200)
    if endpoint.startswith("tcp://"):
        sock.setsockopt(zmq.HEARTBEAT_IVL, 1000)
        sock.setsockopt(zmq.HEARTBEAT_TIMEOUT, 3000)
    try:
        sock.connect(endpoint)
    except zmq.ZMQError as error:
        sock.close()
        raise EndpointError(f"cannot connect to {endpoint}: {error.strerror or error}") from None
    return sock


def send(sock: zmq.Socket[Any], message: Message, to: bytes | None = None) -> bool:
    """Send now; False when the other side is gone or its queue is full."""
    frames = encode(message)
    parts: Sequence[Any] = frames if to is None else [to, *frames]
    try:
        sock.send_multipart(parts, zmq.NOBLOCK, copy=len(frames) == 1)
    except zmq.ZMQError:
        return False
    return True


def receive(sock: zmq.Socket[Any]) -> list[Any] | None:
    """The frames of the next message, or None when there is none now. Large frames are not copied."""
    if not int(sock.get(zmq.EVENTS)) & zmq.POLLIN:  # cheaper than the exception that tells of none
        return None
    parts = sock.recv_multipart(zmq.NOBLOCK, copy=False)
    return [p.buffer if len(p) > 4096 else p.bytes for p in parts]


def sender_name(identity: bytes) -> str:
    """How the log calls a client: its own name if that is one of ours, otherwise the hex of its identity."""
    return identity.decode() if NAME.fullmatch(identity) else identity.hex()[:64]


def receive_message(sock: zmq.Socket[Any]) -> Message | None:
    """The next valid message of a client's socket, or None. A frame that is none raises CodecError."""
    frames = receive(sock)
    if frames is None:
        return None
    if len(frames) > PARTS:
        raise CodecError("malformed", f"{len(frames)} frames, at most {PARTS} are taken")
    return decode(frames)
