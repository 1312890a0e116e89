"""Endpoints: what may be bound and connected to, and that everything else is refused in a sentence before ZeroMQ."""

from __future__ import annotations

import io
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zmq

from tmc.wire import endpoints, sockets
from tmc.wire.endpoints import MAX_PATH_BYTES, Endpoint, EndpointError, parse
from tmc.wire.messages import PolicyRequest

USES: dict[str, Callable[[str], object]] = {
    "bind": endpoints.to_bind, "connect": endpoints.to_connect, "the learner's": endpoints.learner_endpoint,
}  # fmt: skip
"""Everything that an endpoint of a user comes to."""


def refused(use: Callable[[str], object], text: str) -> str:
    """The one printable sentence that `use` refuses an endpoint with."""
    with pytest.raises(EndpointError) as caught:
        use(text)
    assert str(caught.value).isprintable()
    return str(caught.value)


@pytest.mark.parametrize("use", USES.values(), ids=USES)
@pytest.mark.parametrize(
    "bad",
    [
        "", "5555", "127.0.0.1:5555", "tcp://", "tcp://127.0.0.1", "tcp://127.0.0.1:", "tcp://127.0.0.1:70000",
        "tcp://127.0.0.1:0", "tcp://127.0.0.1:-1", "tcp://127.0.0.1:5555/", "tcp://127.0.0.1: 5555",
        " tcp://127.0.0.1:5555", "tcp://127.0.0.1:5555\n", "tcp://127.0.0.1:+55", "tcp://[::1]", "tcp://::1:5555",
        "tcp://[::g]:5555", "tcp://[127.0.0.1]:5555", "tcp://[]:5555", "tcp://:5555", "tcp://*:*",
        "tcp://127.0.0.1:1;127.0.0.1:2", "tcp://h\x1b[31m:5555", "tcp://h\N{RIGHT-TO-LEFT OVERRIDE}:5555",
        "tcp://h:\N{ARABIC-INDIC DIGIT FIVE}", "TCP://127.0.0.1:5555", "inproc://x", "udp://127.0.0.1:5555",
        "pgm://eth0;239.192.1.1:5555", "http://127.0.0.1:80", "ipc://", "ipc:///tmp/\udcff", "ipc:///tmp/a\tb",
        "tcp://\0:5555", pytest.param("tcp://127.0.0.1:" + "9" * 5000, id="5000 digits"),
    ],
)  # fmt: skip
def test_what_is_not_an_endpoint_is_refused_wherever_it_is_used(use: Callable[[str], object], bad: str) -> None:
    sentence = refused(use, bad)
    assert "is not an endpoint" in sentence
    assert "tcp://" in sentence
    assert len(sentence) < 300


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("tcp://127.0.0.1:5555", Endpoint("127.0.0.1", 5555)),
        ("tcp://*:1", Endpoint("*", 1)),
        ("tcp://mission-control:65535", Endpoint("mission-control", 65535)),
        ("tcp://[::1]:5555", Endpoint("::1", 5555, ipv6=True)),
        ("tcp://[fe80::1%eth0]:5555", Endpoint("fe80::1%eth0", 5555, ipv6=True)),
        ("ipc:///run/team one/\N{LATIN SMALL LETTER E WITH ACUTE}", Endpoint(path="/run/team one/\xe9")),
        ("ipc://@abstract", Endpoint(path="@abstract")),
    ],
)
def test_the_parts_of_an_endpoint_and_back(text: str, parts: Endpoint) -> None:
    assert parse(text) == parts
    assert str(parts) == text


@pytest.mark.parametrize("use", [endpoints.to_bind, endpoints.to_connect])
def test_a_host_that_cannot_be_found_is_refused(use: Callable[[str], object], monkeypatch: pytest.MonkeyPatch) -> None:
    """ZeroMQ alone looks for it for ever."""
    assert "cannot be resolved" in refused(use, "tcp://a..b:5555")
    assert "cannot be resolved" in refused(use, f"tcp://{'x' * 70}.example:5555")

    def nowhere(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", nowhere)
    assert "elsewhere cannot be resolved (Name or service not known)" in refused(use, "tcp://elsewhere:5555")


def test_a_star_and_an_interface_are_for_the_tmc_alone() -> None:
    assert "name the host" in refused(endpoints.to_connect, "tcp://*:5555")
    assert endpoints.to_bind("tcp://*:5555").host == "*"
    for _, name in socket.if_nameindex():
        assert endpoints.to_bind(f"tcp://{name}:5555").host == name


def test_a_name_is_bound_by_its_address_and_connected_to_by_name() -> None:
    """ZeroMQ binds no names; it asks for the address of a name again whenever it connects again."""
    assert endpoints.to_bind("tcp://localhost:5555").host in {"127.0.0.1", "::1"}
    assert endpoints.to_connect("tcp://localhost:5555").host == "localhost"


@pytest.mark.parametrize("use", [endpoints.to_bind, endpoints.to_connect])
def test_a_path_that_no_socket_can_have_is_refused(
    use: Callable[[str], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert f"a socket's may have {MAX_PATH_BYTES}" in refused(use, "ipc://" + "x" * (MAX_PATH_BYTES + 1))
    assert "there is no folder nowhere" in refused(use, "ipc://nowhere/sync")
    (tmp_path / "thesis.txt").write_text("three years of work")
    for path in ("thesis.txt", ".", "*"):
        assert "is not a socket" in refused(use, f"ipc://{path}")
    assert use("ipc://" + "x" * MAX_PATH_BYTES)
    assert use("ipc://@" + "x" * (MAX_PATH_BYTES - 1))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_is_not_writable_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert f"{tmp_path} is not writable" in refused(endpoints.to_bind, f"ipc://{tmp_path}/sync")


def test_a_name_that_has_an_ipv6_address_only_is_asked_for_that(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(socket.AF_INET6, socket.SOCK_STREAM, 6, "", ("2001:db8::7", 5555, 0, 0))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    monkeypatch.setattr(socket, "socket", lambda *_: io.BytesIO())  # this machine may have no IPv6
    assert endpoints.to_connect("tcp://elsewhere:5555") == Endpoint("elsewhere", 5555, ipv6=True)
    assert str(endpoints.to_bind("tcp://elsewhere:5555")) == "tcp://[2001:db8::7]:5555"


def has_ipv6() -> bool:
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


@pytest.mark.skipif(not has_ipv6(), reason="this machine has no IPv6")
def test_a_message_over_ipv6() -> None:
    with zmq.Context() as context:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
            endpoint = f"tcp://[::1]:{probe.getsockname()[1]}"
        assert meets(context, endpoint, endpoint)


def test_a_message_to_a_name() -> None:
    with zmq.Context() as context:
        endpoint = f"tcp://localhost:{sockets.free_port()}"
        assert meets(context, endpoint, endpoint)


def meets(context: zmq.Context[Any], bound: str, connected: str) -> bool:
    server, client = sockets.router(context, bound), sockets.dealer(context, connected, "uav-000")
    sockets.send(client, PolicyRequest(1))
    came = bool(server.poll(10_000))
    server.close()
    client.close()
    return came


def test_a_client_says_whether_anything_listens_where_it_waits() -> None:
    port = sockets.free_port()
    endpoint = f"tcp://127.0.0.1:{port}"
    assert "nothing listens so far" in sockets.waiting(endpoint)
    with socket.create_server(("127.0.0.1", port)):
        assert "a process listens but does not answer" in sockets.waiting(endpoint)


def test_looking_whether_an_endpoint_is_free_leaves_no_file(tmp_path: Path) -> None:
    sockets.check_free(f"ipc://{tmp_path}/sync")
    assert not [*tmp_path.iterdir()]


def test_a_path_that_another_process_has_taken_is_not_removed(tmp_path: Path) -> None:
    path = tmp_path / "sync"
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        sockets.unlink(f"ipc://{path}")
        assert path.is_socket()
    sockets.unlink(f"ipc://{path}")
    assert not path.exists()
    path.write_text("three years of work")
    sockets.unlink(f"ipc://{path}")
    assert path.read_text()
