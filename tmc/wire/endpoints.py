"""Check an endpoint, `tcp://HOST:PORT` or `ipc://PATH`, before ZeroMQ uses it.

ZeroMQ turns port 70000 into 4464, waits for ever for a host that does not exist, and takes over the path of another
process. So every endpoint of a command line or of a plan is checked here.
"""

from __future__ import annotations

import ipaddress
import os
import re
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from tmc.kernel.errors import OverflyError
from tmc.kernel.text import printable

MAX_PATH_BYTES = 107 if sys.platform == "linux" else 103
"""Longest path of a socket: `sun_path` of unix(7), without the final zero byte."""
LAST_PORT = 65_535
LEARNER_SUFFIX = ".learner"
"""Appended to the path of the UAVs' socket for the learner's."""
_TCP = re.compile(r"tcp://(?:\[(?P<ipv6>[^][/]+)\]|(?P<host>[^][/:;\s]+)):(?P<port>[0-9]{1,5})")
_FIX = "write tcp://HOST:PORT or ipc://PATH"


class EndpointError(OverflyError, ValueError):
    """An endpoint cannot be used. The text is one sentence with the fix."""


@dataclass(frozen=True)
class Endpoint:
    """`host` and `port`, or `path`. `ipv6`: the host is an IPv6 address, or a name with IPv6 addresses only."""

    host: str = ""
    port: int = 0
    path: str = ""
    ipv6: bool = False

    def __str__(self) -> str:
        if self.path:
            return f"ipc://{self.path}"
        return f"tcp://[{self.host}]:{self.port}" if ":" in self.host else f"tcp://{self.host}:{self.port}"


def parse(text: str) -> Endpoint:
    """Parse an endpoint, without checking that host or path exist. Raises EndpointError."""
    wrong = f"'{printable(text)[:100]}' is not an endpoint"
    if not text.isprintable():
        raise EndpointError(f"{wrong}, it holds a control character: {_FIX}")
    if path := text.removeprefix("ipc://") if text.startswith("ipc://") else "":
        return Endpoint(path=path)
    found = _TCP.fullmatch(text)
    if found is None:
        if text.startswith("tcp://") and text.count(":") > 2 and "[" not in text:
            raise EndpointError(f"{wrong}: write an IPv6 address in brackets, tcp://[ADDRESS]:PORT")
        raise EndpointError(f"{wrong}: {_FIX}")
    port = int(found["port"])
    if not 0 < port <= LAST_PORT:
        raise EndpointError(f"{wrong}, it has no port from 1 to {LAST_PORT}: {_FIX}")
    if found["ipv6"]:
        try:
            ipaddress.IPv6Address(found["ipv6"])
        except ValueError:
            raise EndpointError(f"{wrong}, its brackets do not hold an IPv6 address: {_FIX}") from None
    return Endpoint(found["ipv6"] or found["host"], port, ipv6=bool(found["ipv6"]))


def learner_endpoint(sync: str) -> str:
    """Return the learner's endpoint for that of the UAVs: the next tcp port, or the ipc path with LEARNER_SUFFIX."""
    endpoint = parse(sync)
    if endpoint.path:
        return str(replace(endpoint, path=endpoint.path + LEARNER_SUFFIX))
    if endpoint.port == LAST_PORT:
        raise EndpointError(f"'{sync}' is not an endpoint of a TMC, whose learner needs the next port: {_FIX}")
    return str(replace(endpoint, port=endpoint.port + 1))


def to_bind(text: str) -> Endpoint:
    """Return the endpoint to bind, with the host's address instead of its name. Raises EndpointError."""
    endpoint = _parsed("bind", text)
    if endpoint.path:
        return _checked("bind", endpoint, _wrong_to_bind)
    if endpoint.ipv6 or endpoint.host == "*" or endpoint.host in (name for _, name in socket.if_nameindex()):
        return endpoint
    known, address = _resolved("bind", text, endpoint)
    return replace(known, host=address)


def to_connect(text: str) -> Endpoint:
    """Return the endpoint to connect to; EndpointError when nothing can listen there.

    The name of a host is kept, since ZeroMQ resolves it again at each new connection.
    """
    endpoint = _parsed("connect to", text)
    if endpoint.path:
        return _checked("connect to", endpoint, _wrong_to_connect)
    if endpoint.host == "*":
        raise EndpointError(f"cannot connect to {text}: * is for the TMC's --bind; name the host that the TMC is on")
    return _resolved("connect to", text, endpoint)[0]


def listens(text: str) -> bool:
    """Return True when any process accepts connections at an endpoint now."""
    try:
        return _listens(parse(text))
    except EndpointError:
        return False


def _listens(endpoint: Endpoint) -> bool:
    try:
        if not endpoint.path:
            socket.create_connection((endpoint.host, endpoint.port), timeout=0.5).close()
            return True
        with socket.socket(socket.AF_UNIX) as probe:
            return probe.connect_ex(("\0" + endpoint.path[1:]) if _abstract(endpoint) else endpoint.path) == 0
    except (OSError, UnicodeError):
        return False


def _parsed(what: str, text: str) -> Endpoint:
    try:
        return parse(text)
    except EndpointError as error:
        raise EndpointError(f"cannot {what} it: {error}") from None


def _abstract(endpoint: Endpoint) -> bool:
    """Return True for a name of Linux's abstract namespace, which is not in any folder."""
    return endpoint.path.startswith("@")


def _checked(what: str, endpoint: Endpoint, wrong: Callable[[Endpoint, Path], str]) -> Endpoint:
    """Return the endpoint; EndpointError when its path cannot be that of a socket here."""
    path, size = Path(endpoint.path), len(os.fsencode(endpoint.path))
    if size > MAX_PATH_BYTES:
        why = f"its path has {size} bytes, and a socket's may have {MAX_PATH_BYTES}; choose a shorter one"
    else:
        try:
            why = "" if _abstract(endpoint) else _wrong_path(endpoint, path)
            why = why or wrong(endpoint, path)
        except OSError as error:  # a folder that must not be read
            why = f"{error.strerror}; choose another path"
    if why:
        raise EndpointError(f"cannot {what} {endpoint}: {why}")
    return endpoint


def _wrong_path(endpoint: Endpoint, path: Path) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent}; make it, or choose another path"
    if endpoint.path == "*" or (path.exists() and not path.is_socket()):
        return f"{path} is not a socket; choose another path"
    return ""


def _wrong_to_bind(endpoint: Endpoint, path: Path) -> str:
    if _listens(endpoint):
        return "it is in use by another process; choose another path"
    if not _abstract(endpoint) and not os.access(path.parent, os.W_OK | os.X_OK):
        return f"{path.parent} is not writable; choose another path"
    return ""


def _wrong_to_connect(_: Endpoint, path: Path) -> str:
    there = path.exists() and not os.access(path, os.W_OK)
    return f"{path} belongs to another user; run both processes as one user" if there else ""


def _resolved(what: str, text: str, endpoint: Endpoint) -> tuple[Endpoint, str]:
    """Return the endpoint with its host's name in ASCII, and an address of the host, IPv4 if it has one."""
    try:
        name = endpoint.host if endpoint.ipv6 else endpoint.host.encode("idna").decode("ascii")
        found = {
            entry[0]: str(entry[4][0]) for entry in socket.getaddrinfo(name, endpoint.port, type=socket.SOCK_STREAM)
        }
        ipv6 = socket.AF_INET not in found
        if ipv6:
            socket.socket(socket.AF_INET6).close()  # the system may have none
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not the name of a host"
        why = f"{endpoint.host} cannot be resolved ({reason}); correct the host, or give its address"
        raise EndpointError(f"cannot {what} {text}: {why}") from None
    return replace(endpoint, host=name, ipv6=ipv6), found[socket.AF_INET6 if ipv6 else socket.AF_INET]
