"""The sockets, with real ZeroMQ over ipc and tcp: who binds what, what passes, and what a stranger cannot break."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from tmc.wire import sockets
from tmc.wire.codec import CodecError, decode, encode
from tmc.wire.messages import Ack, Hello, Message, Minibatch, PolicyRequest
from tmc.wire.sockets import EndpointError

PATIENCE_MS = 100_000
"""Longest wait for a message, milliseconds."""
Same = Callable[[Message, Message], bool]
Sock = zmq.Socket[Any]


class Radio:
    """The sockets of a test, closed at its end."""

    def __init__(self, context: zmq.Context[Any]) -> None:
        self._context, self._open = context, list[Sock]()

    def _keep(self, sock: Sock) -> Sock:
        self._open.append(sock)
        return sock

    def router(self, endpoint: str) -> Sock:
        return self._keep(sockets.router(self._context, endpoint))

    def dealer(self, endpoint: str, name: str) -> Sock:
        return self._keep(sockets.dealer(self._context, endpoint, name))

    def stranger(self, endpoint: str, name: bytes) -> Sock:
        """A client that keeps no rule of ours."""
        sock = self._keep(self._context.socket(zmq.DEALER))
        sock.setsockopt(zmq.LINGER, 0)
        sock.setsockopt(zmq.IDENTITY, name)
        sock.connect(endpoint)
        return sock

    def close(self) -> None:
        for sock in self._open:
            sock.close()


@pytest.fixture
def radio() -> Iterator[Radio]:
    """That this comes to its end shows that nothing lingers."""
    with zmq.Context() as context:
        made = Radio(context)
        yield made
        made.close()


@pytest.fixture(params=["ipc", "tcp"])
def endpoint(request: pytest.FixtureRequest, short: Path) -> str:
    return f"ipc://{short}/sync" if request.param == "ipc" else f"tcp://127.0.0.1:{sockets.free_port()}"


@pytest.fixture
def ipc(short: Path) -> str:
    return f"ipc://{short}/sync"


def wait(sock: Sock) -> list[Any]:
    """The frames of the next message."""
    assert sock.poll(PATIENCE_MS), "nothing came"
    frames = sockets.receive(sock)
    assert frames is not None
    return frames


def wait_message(sock: Sock) -> Message:
    """The next message of a client's socket."""
    assert sock.poll(PATIENCE_MS), "nothing came"
    message = sockets.receive_message(sock)
    assert message is not None
    return message


def meet(bound: Sock, client: Sock, name: bytes) -> None:
    """One round trip, after which both sides know each other."""
    assert sockets.send(client, PolicyRequest(7))
    identity, *frames = wait(bound)
    assert (identity, decode(frames)) == (name, PolicyRequest(7))
    assert sockets.send(bound, Ack(7), to=name)
    assert wait_message(client) == Ack(7)


def batch(b: int) -> Minibatch:
    maps = np.random.default_rng(1).random((2 * b, 2700)).astype("<f4")
    cells, ones = np.zeros(2 * b, "<u2"), np.ones(b, "<f4")
    rest = (ones, ones, np.ones((b, 9), "u1"), np.arange(b))
    return Minibatch(1, 2, 3, cells, cells[:, None], maps, np.ones(b, "u1"), *rest)


# Round trips


def test_round_trip(radio: Radio, endpoint: str, same: Same) -> None:
    """A named client's word, and an answer of a megabyte to that name."""
    bound, client = radio.router(endpoint), radio.dealer(endpoint, "uav-002")
    hello, answer = Hello("uav", 2, 99), batch(64)
    assert sockets.send(client, hello)
    identity, *frames = wait(bound)
    assert identity == b"uav-002"
    assert decode(frames) == hello
    assert sockets.send(bound, answer, to=identity)
    assert same(wait_message(client), answer)


def test_large_frames_are_not_copied(radio: Radio, ipc: str) -> None:
    bound, client = radio.router(ipc), radio.dealer(ipc, "learner")
    meet(bound, client, b"learner")
    assert sockets.send(bound, batch(8), to=b"learner")
    frames = wait(client)
    assert [type(f) for f in (frames[0], frames[3])] == [bytes, memoryview]
    message = decode(frames)
    assert isinstance(message, Minibatch)
    assert np.shares_memory(message.u, np.frombuffer(frames[3], "u1"))


def test_every_client_gets_its_own_answer(radio: Radio, endpoint: str) -> None:
    bound = radio.router(endpoint)
    clients = [radio.dealer(endpoint, f"uav-{i:03d}") for i in range(5)]
    for i, client in enumerate(clients):
        assert sockets.send(client, PolicyRequest(i))
    for _ in clients:
        identity, *frames = wait(bound)
        request = decode(frames)
        assert isinstance(request, PolicyRequest)
        assert sockets.send(bound, Ack(request.version), to=identity)
    assert [wait_message(client) for client in clients] == [Ack(i) for i in range(5)]


def test_nothing_there_is_none(radio: Radio, endpoint: str) -> None:
    bound, client = radio.router(endpoint), radio.dealer(endpoint, "learner")
    assert sockets.receive(bound) is None
    assert sockets.receive_message(client) is None


def test_a_client_may_come_before_the_tmc(radio: Radio, endpoint: str) -> None:
    client = radio.dealer(endpoint, "uav-000")
    assert sockets.send(client, PolicyRequest(1))
    assert decode(wait(radio.router(endpoint))[1:]) == PolicyRequest(1)


def test_a_client_finds_the_tmc_again(radio: Radio, endpoint: str) -> None:
    """A TMC that was killed and comes back on its endpoint: the client connects again by itself."""
    bound, client = radio.router(endpoint), radio.dealer(endpoint, "uav-000")
    meet(bound, client, b"uav-000")
    bound.close()
    again = None
    deadline = time.monotonic() + PATIENCE_MS / 1000
    while again is None:
        try:
            again = radio.router(endpoint)
        except EndpointError:  # ZeroMQ gives the endpoint up in a thread of its own
            assert time.monotonic() < deadline
            time.sleep(0.01)
    while not again.poll(100):  # a request in flight may be lost, so ask again, as the services do
        assert time.monotonic() < deadline
        sockets.send(client, PolicyRequest(1))
    assert wait(again)[0] == b"uav-000"


def test_a_new_process_takes_over_its_name(radio: Radio, endpoint: str) -> None:
    bound, old = radio.router(endpoint), radio.dealer(endpoint, "uav-001")
    meet(bound, old, b"uav-001")
    new = radio.dealer(endpoint, "uav-001")
    meet(bound, new, b"uav-001")
    assert sockets.send(bound, Ack(2), to=b"uav-001")
    assert wait_message(new) == Ack(2)
    assert not old.poll(50)


# What cannot be sent


def test_a_message_to_no_client_is_not_sent(radio: Radio, endpoint: str) -> None:
    bound = radio.router(endpoint)
    assert sockets.send(bound, Ack(1), to=b"uav-009") is False
    client = radio.dealer(endpoint, "uav-009")
    meet(bound, client, b"uav-009")


def test_a_full_queue_does_not_block(radio: Radio, ipc: str) -> None:
    """A client whose TMC never came: at some point the answer is False, at once."""
    client = radio.dealer(ipc, "uav-000")
    assert not all(sockets.send(client, PolicyRequest(i)) for i in range(5000))


def test_nothing_is_sent_on_a_closed_socket(radio: Radio, ipc: str) -> None:
    client = radio.dealer(ipc, "uav-000")
    client.close()
    assert sockets.send(client, PolicyRequest(1)) is False


def test_unsent_messages_do_not_keep_a_process() -> None:
    """No linger: the default waits for ever at exit for a TMC that never comes, and this test would not end."""
    with zmq.Context() as context:
        client = sockets.dealer(context, f"tcp://127.0.0.1:{sockets.free_port()}", "uav-000")
        assert sockets.send(client, PolicyRequest(1))
        client.close()


# Strangers


def test_an_oversize_part_is_dropped_and_the_others_go_on(radio: Radio, endpoint: str) -> None:
    """One byte over the limit: it never reaches the TMC, and the connections of others are not touched."""
    bound, client = radio.router(endpoint), radio.dealer(endpoint, "uav-000")
    meet(bound, client, b"uav-000")
    with radio.stranger(endpoint, b"evil") as evil:
        evil.send_multipart([b"small"])
        assert wait(bound) == [b"evil", b"small"]
        evil.send(bytes(sockets.FRAME_LIMIT_BYTES + 1), copy=False)
        for _ in range(20):
            meet(bound, client, b"uav-000")
        assert not bound.poll(200)
    meet(bound, client, b"uav-000")


def test_an_oversize_part_from_the_other_side_does_not_reach_a_client(radio: Radio, ipc: str) -> None:
    """ZeroMQ gives that connection up: a new socket gets through, and no other client notices."""
    bound, client = radio.router(ipc), radio.dealer(ipc, "uav-000")
    meet(bound, client, b"uav-000")
    other = radio.dealer(ipc, "uav-001")
    bound.send_multipart([b"uav-000", bytes(sockets.FRAME_LIMIT_BYTES + 1)], copy=False)
    assert not client.poll(300)
    meet(bound, other, b"uav-001")
    meet(bound, radio.dealer(ipc, "uav-000"), b"uav-000")


def test_frames_that_are_no_message_do_not_break_the_socket(radio: Radio, ipc: str) -> None:
    bound, client = radio.router(ipc), radio.dealer(ipc, "uav-000")
    meet(bound, client, b"uav-000")
    for junk in ([b""], [b"\xc1"], [b"x"] * (sockets.MAX_FRAMES + 1), [*encode(Ack(1)), b"more"], [b"\x80"] * 100):
        bound.send_multipart([b"uav-000", *junk])
        assert client.poll(PATIENCE_MS)
        with pytest.raises(CodecError):
            sockets.receive_message(client)
    meet(bound, client, b"uav-000")


def test_too_many_frames_are_counted_before_they_are_read(radio: Radio, ipc: str) -> None:
    bound, client = radio.router(ipc), radio.dealer(ipc, "uav-000")
    meet(bound, client, b"uav-000")
    bound.send_multipart([b"uav-000", *encode(Ack(1)), *[b"x"] * sockets.MAX_FRAMES])
    assert client.poll(PATIENCE_MS)
    with pytest.raises(CodecError, match=rf"{sockets.MAX_FRAMES + 1} frames, at most {sockets.MAX_FRAMES}"):
        sockets.receive_message(client)


def test_a_flood_and_a_hang_up_leave_the_tmc_standing(radio: Radio, endpoint: str) -> None:
    """With heartbeats on the bound side libzmq 4.3.5 ends the process here."""
    bound, client = radio.router(endpoint), radio.dealer(endpoint, "uav-000")
    meet(bound, client, b"uav-000")
    with radio.stranger(endpoint, b"evil") as evil:
        for _ in range(900):
            evil.send(b"x" * 100, zmq.NOBLOCK)
        assert bound.poll(PATIENCE_MS)
    assert sockets.send(client, PolicyRequest(8))
    while (frames := wait(bound))[0] == b"evil":  # as much of the flood as has come
        pass
    assert (frames[0], decode(frames[1:])) == (b"uav-000", PolicyRequest(8))
    assert bound.getsockopt(zmq.HEARTBEAT_IVL) == 0


def test_options_follow_what_was_measured(radio: Radio) -> None:
    endpoint = f"tcp://127.0.0.1:{sockets.free_port()}"
    bound, client = radio.router(endpoint), radio.dealer(endpoint, "uav-000")
    for sock in (bound, client):
        assert sock.getsockopt(zmq.LINGER) == 0
        assert sock.getsockopt(zmq.MAXMSGSIZE) == sockets.FRAME_LIMIT_BYTES
    assert bound.getsockopt(zmq.RCVHWM) == 32
    assert client.getsockopt(zmq.HEARTBEAT_IVL) == 1000


@pytest.mark.parametrize(
    ("identity", "name"),
    [
        (b"uav-000", "uav-000"),
        (b"uav-12345", "uav-12345"),
        (b"learner", "learner"),
        (b"observer-ab-1", "observer-ab-1"),
        (b"\x00\x01\x02", "000102"),
        (b"uav-1", b"uav-1".hex()),
        (b"uav-000\n", b"uav-000\n".hex()),
        (b"learner\x1b[31m", b"learner\x1b[31m".hex()),
        (b"\xff" * 255, "ff" * 32),
        (b"", ""),
    ],
)
def test_the_log_writes_no_strangers_bytes(identity: bytes, name: str) -> None:
    assert sockets.sender_name(identity) == name


# Endpoints that cannot be used: one sentence


def sentence(error: BaseException) -> str:
    text = str(error)
    assert text
    assert "\n" not in text
    assert "Traceback" not in text
    return text


def test_a_busy_port_is_refused(radio: Radio) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(
            EndpointError, match=f"cannot bind {re.escape(endpoint)}.*in use.*choose a free port"
        ) as caught:
            radio.router(endpoint)
        sentence(caught.value)


def test_an_endpoint_in_use_is_refused_and_its_owner_goes_on(radio: Radio, endpoint: str) -> None:
    """ZeroMQ alone would take an ipc path away from another TMC without a word."""
    bound, client = radio.router(endpoint), radio.dealer(endpoint, "uav-000")
    meet(bound, client, b"uav-000")
    with pytest.raises(EndpointError, match=f"{re.escape(endpoint)}.*in use.*choose") as caught:
        radio.router(endpoint)
    sentence(caught.value)
    meet(bound, client, b"uav-000")
    late = radio.dealer(endpoint, "uav-001")
    meet(bound, late, b"uav-001")


def test_a_path_left_behind_by_a_killed_tmc_is_taken(radio: Radio, short: Path) -> None:
    path = short / "sync"
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(path))
    assert path.is_socket()
    bound, client = radio.router(f"ipc://{path}"), radio.dealer(f"ipc://{path}", "uav-000")
    meet(bound, client, b"uav-000")


def test_a_file_in_the_way_is_not_removed(radio: Radio, tmp_path: Path) -> None:
    """ZeroMQ unlinks whatever stands on an ipc path, a user's file too."""
    path = tmp_path / "thesis.txt"
    path.write_text("three years of work")
    with pytest.raises(EndpointError) as caught:
        radio.router(f"ipc://{path}")
    sentence(caught.value)
    assert path.read_text() == "three years of work"


@pytest.mark.parametrize(
    "bad", ["", "5555", "bogus", "tcp://", "tcp://127.0.0.1", "ipc://", "http://127.0.0.1:80", "tcp://999.1.1.1:80"]
)
def test_what_is_no_endpoint_cannot_be_bound(bad: str, radio: Radio) -> None:
    with pytest.raises(EndpointError) as caught:
        radio.router(bad)
    sentence(caught.value)


def test_a_port_that_does_not_exist_is_refused(radio: Radio) -> None:
    """ZeroMQ alone takes the port modulo 65,536, so that no client finds the TMC."""
    with pytest.raises(EndpointError):
        radio.router("tcp://127.0.0.1:99999")


def test_a_folder_that_is_not_there_is_refused(radio: Radio, tmp_path: Path) -> None:
    for path in (tmp_path / "nowhere" / "sync", tmp_path / ("x" * 120), tmp_path):
        with pytest.raises(EndpointError, match="cannot bind") as caught:
            radio.router(f"ipc://{path}")
        sentence(caught.value)


@pytest.mark.parametrize("bad", ["", "bogus", "tcp://127.0.0.1", "http://127.0.0.1:80"])
def test_what_is_no_endpoint_cannot_be_connected_to(bad: str, radio: Radio) -> None:
    with pytest.raises(EndpointError, match="cannot connect to") as caught:
        radio.dealer(bad, "uav-000")
    sentence(caught.value)


@pytest.mark.parametrize(
    ("sync", "feed"),
    [
        ("tcp://127.0.0.1:5555", "tcp://127.0.0.1:5556"),
        ("tcp://*:1", "tcp://*:2"),
        ("tcp://[::1]:65534", "tcp://[::1]:65535"),
        ("ipc:///run/overfly/sync", "ipc:///run/overfly/sync.learner"),
        ("ipc://@abstract", "ipc://@abstract.learner"),
    ],
)
def test_the_learners_endpoint_stands_beside_that_of_the_uavs(sync: str, feed: str) -> None:
    assert sockets.learner_endpoint(sync) == feed


@pytest.mark.parametrize(
    "sync",
    [
        "", "5555", "127.0.0.1:5555", "http://h:80", "udp://h:80", "tcp://", "tcp://host", "tcp://host:",
        "tcp://host:port", "tcp://host:0", "tcp://host:-1", "tcp://host:65535", "tcp://host:99999", "tcp://host:5.5",
        "tcp://host: 5555", "ipc://", "ipc:", "inproc://x", "tcp://host:\N{SUPERSCRIPT TWO}",
        pytest.param("tcp://host:" + "9" * 5000, id="5000-digits"),
    ],
)  # fmt: skip
def test_no_endpoint_for_the_learner_is_refused(sync: str) -> None:
    with pytest.raises(EndpointError, match=r"is not an endpoint.*: write tcp://HOST:PORT or ipc://PATH") as caught:
        sockets.learner_endpoint(sync)
    sentence(caught.value)


def test_a_free_port_and_its_successor_can_be_bound(radio: Radio) -> None:
    """Over and over: the pair serves UAVs and learner."""
    for _ in range(5):
        sync = f"tcp://127.0.0.1:{sockets.free_port()}"
        radio.router(sync)
        radio.router(sockets.learner_endpoint(sync))
