"""Hosts on one machine: one network namespace per host, and a switch in user space that delays, loses and cuts.

Each host has one TAP device, which the kernel takes for an Ethernet card; what it sends comes out of a file here, and
what is written to that file arrives there. So no queueing discipline of the kernel is needed (netem is often missing),
only root, `/dev/net/tun` and the command `ip`. Nothing is routed outside: the addresses are those of TEST-NET-2.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import itertools
import os
import random
import select
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

_TUN = Path("/dev/net/tun")
_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
_FRAME = 65_550
_ROUNDS = itertools.count()


class Switch(threading.Thread):
    """Carries Ethernet frames between TAP devices, each `delay` seconds late and lost with probability `loss`.

    A frame goes to the port of its receiver's address; a broadcast, or one for an address not heard yet, to all others.
    """

    def __init__(self, ports: list[int], delay: float, loss: float, seed: int) -> None:
        super().__init__(name="switch", daemon=True)
        self.ports, self.delay, self.loss = ports, delay, loss
        self.away: set[int] = set()  # ports whose cable is pulled
        self.passed = self.lost = self.severed = 0
        self._draw = random.Random(seed).random
        self._homes: dict[bytes, int] = {}
        self._late: list[tuple[float, int, int, bytes]] = []  # due, order of arrival, port, frame
        self._order = itertools.count()
        self._ear, self._mouth = os.pipe()

    def run(self) -> None:
        """Carry frames until `stop`."""
        poller = select.poll()
        by_file = {file: port for port, file in enumerate(self.ports)}
        for file in (*self.ports, self._ear):
            poller.register(file, select.POLLIN)
        while True:
            patience = 1000 * max(0.0, self._late[0][0] - time.monotonic()) if self._late else None
            for file, _ in poller.poll(patience):
                if file == self._ear:
                    return
                self._take(by_file[file])
            while self._late and self._late[0][0] <= time.monotonic():
                self._give(*heapq.heappop(self._late)[2:])

    def stop(self) -> None:
        """End the thread."""
        os.write(self._mouth, b"!")
        self.join()
        os.close(self._ear)
        os.close(self._mouth)

    def _take(self, port: int) -> None:
        """Take one frame from a host."""
        try:
            frame = os.read(self.ports[port], _FRAME)
        except BlockingIOError:
            return
        receiver, sender = frame[:6], frame[6:12]
        self._homes[sender] = port
        home = self._homes.get(receiver)
        for to in range(len(self.ports)) if home is None else (home,):
            if to == port:
                continue
            if port in self.away or to in self.away:
                self.severed += 1
            elif self._draw() < self.loss:
                self.lost += 1
            else:
                heapq.heappush(self._late, (time.monotonic() + self.delay, next(self._order), to, frame))

    def _give(self, port: int, frame: bytes) -> None:
        """Deliver one frame to a host; a full queue loses it, as in a switch."""
        with contextlib.suppress(BlockingIOError):
            os.write(self.ports[port], frame)
            self.passed += 1


class Hosts:
    """The hosts of a test, numbered from 0: each has an address and a way to start commands."""

    def __init__(self, names: list[str], switch: Switch) -> None:
        self.names, self.switch = names, switch

    def address(self, host: int) -> str:
        """Return the host's IPv4 address."""
        return _address(host)

    def on(self, host: int, *command: object) -> list[str]:
        """Return the command line that runs `command` on a host."""
        return ["ip", "netns", "exec", self.names[host], *map(str, command)]

    @contextlib.contextmanager
    def cut(self, host: int) -> Iterator[None]:
        """Disconnect a host for the length of the block."""
        self.switch.away.add(host)
        try:
            yield
        finally:
            self.switch.away.discard(host)


@contextlib.contextmanager
def hosts(count: int, *, delay: float = 0.02, loss: float = 0.02, seed: int = 0) -> Iterator[Hosts]:
    """Yield `count` hosts behind one switch, with `delay` seconds and `loss` each way; remove them at the end."""
    run = f"{os.getpid():x}-{next(_ROUNDS)}"  # so that parallel test runs use different names
    with contextlib.ExitStack() as undo:
        names, ports = [], []
        for host in range(count):
            name, device = f"overfly-{run}-{host}", f"ofly{run}.{host}"[-15:]
            _ip("netns", "add", name)
            undo.callback(_ip, "netns", "del", name)
            ports.append(_tap(device))
            undo.callback(os.close, ports[-1])  # with it goes the device
            _ip("link", "set", device, "netns", name, "name", "eth0")
            _ip("-n", name, "address", "add", f"{_address(host)}/24", "dev", "eth0")
            for card in ("lo", "eth0"):
                _ip("-n", name, "link", "set", card, "up")
            names.append(name)
        switch = Switch(ports, delay, loss, seed)
        switch.start()
        undo.callback(switch.stop)
        yield Hosts(names, switch)


def why_not() -> str:
    """Return why this machine cannot have such hosts; "" if it can."""
    if os.geteuid():
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "there is no command `ip`: install iproute2"
    if not _TUN.exists():
        return f"there is no {_TUN}: this kernel has no TAP devices, or the container does not show them"
    try:
        with hosts(1):
            return ""
    except (OSError, subprocess.CalledProcessError) as error:
        said = error.stderr.strip() if isinstance(error, subprocess.CalledProcessError) else str(error)
        return f"the kernel refuses a namespace with a TAP device: {said}"


def _address(host: int) -> str:
    return f"198.51.100.{host + 1}"


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


def _tap(device: str) -> int:
    """Return the file of a new TAP device, which exists as long as the file is open."""
    file = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.ioctl(file, _TUNSETIFF, struct.pack("16sH22x", device.encode(), _IFF_TAP | _IFF_NO_PI))
    except OSError:
        os.close(file)
        raise
    return file
