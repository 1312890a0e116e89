"""Open and use the sockets: the TMC binds, all other processes connect.

Options follow measurements (docs/explanation/architecture.md): no linger, since it hangs at exit; a short queue, since
its limit counts messages, not bytes; a size limit per frame; heartbeats on the connecting side only, because a peer
that fills its queue and leaves can abort a bound ROUTER with heartbeats.
"""

from __future__ import annotations

import errno
import re
import socket
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import zmq

from tmc.wire.codec import CodecError, decode, encode
from tmc.wire.endpoints import EndpointError, learner_endpoint, listens, parse, to_bind, to_connect
from tmc.wire.fields import FRAME_LIMIT_BYTES
from tmc.wire.messages import Message

MAX_FRAMES = 16
"""Most frames in a message."""
NAME = re.compile(rb"uav-[0-9]{3,5}|learner|observer-[0-9a-z-]{1,40}")
"""The names of clients."""
FIXES = {
    errno.EADDRNOTAVAIL: "choose an address of this machine, or * for all of them",
    errno.ENODEV: "choose an address of this machine, or * for all of them",
    errno.EACCES: "choose a port from 1024 on",
}
"""The fix for an endpoint that cannot be bound, by the reason."""
__all__ = [
    "EndpointError",
    "check_free",
    "dealer",
    "free_port",
    "learner_endpoint",
    "receive",
    "receive_message",
    "router",
    "send",
    "sender_name",
    "unlink",
    "waiting",
]  # fmt: skip


def free_port() -> int:
    """Return a free tcp port of this machine whose successor is free too."""
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
    ends = (endpoint, learner_endpoint(endpoint))
    with zmq.Context() as context:
        for one in ends:
            router(context, one).close()
    for one in ends:
        unlink(one)


def router(context: zmq.Context[Any], endpoint: str, queue: int = 32) -> zmq.Socket[Any]:
    """Return a bound ROUTER. A client that reconnects takes over its name; a message to no client raises."""
    place = to_bind(endpoint)
    sock: zmq.Socket[Any] = context.socket(zmq.ROUTER)
    sock.setsockopt(zmq.LINGER, 0)
    sock.setsockopt(zmq.RCVHWM, queue)
    sock.setsockopt(zmq.SNDHWM, 1000)
    sock.setsockopt(zmq.MAXMSGSIZE, FRAME_LIMIT_BYTES)
    sock.setsockopt(zmq.ROUTER_HANDOVER, 1)
    sock.setsockopt(zmq.ROUTER_MANDATORY, 1)
    sock.setsockopt(zmq.IPV6, place.ipv6)
    try:
        sock.bind(str(place))
    except zmq.ZMQError as error:
        sock.close()
        why = (error.strerror or str(error)).partition(" (addr=")[0]
        fix = FIXES.get(error.errno or 0, "choose a free port or path")
        raise EndpointError(f"cannot bind {endpoint}: {why}; {fix}") from None
    return sock


def unlink(endpoint: str) -> None:
    """Remove the socket file of a closed ROUTER, which ZeroMQ leaves."""
    path = Path(parse(endpoint).path or "@")
    with suppress(OSError):
        if path.is_socket() and not listens(endpoint):
            path.unlink()


def dealer(context: zmq.Context[Any], endpoint: str, name: str) -> zmq.Socket[Any]:
    """Return a connected DEALER with this name. ZeroMQ reconnects by itself."""
    place = to_connect(endpoint)
    sock: zmq.Socket[Any] = context.socket(zmq.DEALER)
    sock.setsockopt(zmq.LINGER, 0)
    sock.setsockopt(zmq.IDENTITY, name.encode())
    sock.setsockopt(zmq.MAXMSGSIZE, FRAME_LIMIT_BYTES)
    sock.setsockopt(zmq.RECONNECT_IVL, 50)
    sock.setsockopt(zmq.RECONNECT_IVL_MAX, 200)
    sock.setsockopt(zmq.IPV6, place.ipv6)
    if not place.path:
        sock.setsockopt(zmq.HEARTBEAT_IVL, 1000)
        sock.setsockopt(zmq.HEARTBEAT_TIMEOUT, 3000)
    try:
        sock.connect(str(place))
    except zmq.ZMQError as error:
        sock.close()
        raise EndpointError(f"cannot connect to {endpoint}: {error.strerror or error}") from None
    return sock


def waiting(endpoint: str) -> str:
    """Return why no answer comes from an endpoint, for a client that waits for one."""
    if listens(endpoint):
        return f"{endpoint}, where a process listens but does not answer as a TMC: is it the TMC's --bind?"
    return f"{endpoint}, where nothing listens so far"


def send(sock: zmq.Socket[Any], message: Message, to: bytes | None = None) -> bool:
    """Send a message without waiting; return False when the other side is gone or its queue is full."""
    frames = encode(message)
    parts: Sequence[Any] = frames if to is None else [to, *frames]
    try:
        sock.send_multipart(parts, zmq.NOBLOCK, copy=len(frames) == 1)
    except zmq.ZMQError:
        return False
    return True


def receive(sock: zmq.Socket[Any]) -> list[Any] | None:
    """Return the frames of the next message, or None when there is none. Large frames are not copied."""
    if not int(sock.get(zmq.EVENTS)) & zmq.POLLIN:  # cheaper than an exception
        return None
    parts = sock.recv_multipart(zmq.NOBLOCK, copy=False)
    return [p.buffer if len(p) > 4096 else p.bytes for p in parts]


def sender_name(identity: bytes) -> str:
    """Return the name of a client for the log: its own if valid, otherwise its identity in hex."""
    return identity.decode() if NAME.fullmatch(identity) else identity.hex()[:64]


def receive_message(sock: zmq.Socket[Any]) -> Message | None:
    """Return the next message of a client's socket, or None. CodecError for frames that are not a message."""
    frames = receive(sock)
    if frames is None:
        return None
    if len(frames) > MAX_FRAMES:
        raise CodecError("malformed", f"{len(frames)} frames, at most {MAX_FRAMES} are allowed")
    return decode(frames)
