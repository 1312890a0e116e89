"""The supervisor's side of the forkserver (deploy/run/forkserver.py): forked processes that are used like `Popen`."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from tmc.wire import process


class Handle(Protocol):
    """The interface of a process that the supervisor needs; subprocess.Popen and Forked have it."""

    @property
    def pid(self) -> int | None: ...
    @property
    def returncode(self) -> Any: ...
    def poll(self) -> int | None: ...
    def send_signal(self, sig: int) -> None: ...
    def wait(self, timeout: float | None = None) -> int: ...


class ForkServer:
    """Starts a forkserver with the first process, and again if it was lost.

    `command`: its command line. `log`: the file for its own output.
    """

    def __init__(self, command: Sequence[str], environment: dict[str, str], log: Path) -> None:
        self.command, self.environment, self.log = tuple(command), environment, log
        self._server: subprocess.Popen[bytes] | None = None
        self._children: dict[str, Forked] = {}
        self._rest = b""
        self.orphans: set[int] = set()
        """Processes whose server was lost: where they become children of this process, it must wait for them."""

    @property
    def pid(self) -> int | None:
        """The id of the server's process; None while it does not run."""
        return None if self._server is None else self._server.pid

    def start(self, name: str, argv: Sequence[str], log: Path) -> Forked:
        """Fork a process that runs `argv`, with its output in the file `log`."""
        if self._server is None:
            self._launch()
        self._children[name] = child = Forked(self, name)
        self.send_order({"start": name, "argv": [*argv], "log": str(log.absolute())})
        return child

    def _launch(self) -> None:
        with self.log.open("ab") as errors:
            self._server = subprocess.Popen(
                self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, bufsize=0,
                env=self.environment, start_new_session=True,
            )  # fmt: skip
        self._rest = b""

    def send_order(self, order: dict[str, Any]) -> None:
        """Send an order to the server. If the server has ended, mark its processes as ended."""
        assert self._server is not None and self._server.stdin is not None
        data = json.dumps(order).encode() + b"\n"
        try:
            while data:
                data = data[os.write(self._server.stdin.fileno(), data) :]
        except BrokenPipeError:
            self.receive_reports(0.0)

    def receive_reports(self, timeout: float) -> None:
        """Handle the server's reports; wait up to `timeout` seconds for the first."""
        if self._server is None or self._server.stdout is None:
            return
        pipe = self._server.stdout.fileno()
        while select.select([pipe], [], [], timeout)[0]:
            data, timeout = os.read(pipe, 65_536), 0.0
            if not data:
                self._on_server_lost(self._server.wait())
                return
            *lines, self._rest = (self._rest + data).split(b"\n")
            for line in lines:
                report = json.loads(line)
                child = self._children[report["name"]]
                child.pid = report.get("pid", child.pid)
                child.returncode = report.get("code")

    def _on_server_lost(self, code: int) -> None:
        """Mark all children as ended: killed by the server's signal, or failed if the server failed."""
        self._close()
        for child in self._children.values():
            if child.returncode is None:
                if child.pid is not None:
                    self.orphans.add(child.pid)
                child.returncode = code if code < 0 else process.FAILED
        self._children.clear()

    def _close(self) -> None:
        server, self._server = self._server, None
        for pipe in (server.stdin, server.stdout) if server else ():
            if pipe is not None:
                pipe.close()

    def close(self) -> None:
        """End the server; its remaining children end with it."""
        server = self._server
        self._close()
        if server is not None:
            try:
                server.wait(5.0)
            except subprocess.TimeoutExpired:
                server.kill()
                server.wait()


class Forked:
    """One process of the forkserver. `pid` is None until the server has reported it."""

    def __init__(self, server: ForkServer, name: str) -> None:
        self._server, self.name = server, name
        self.pid: int | None = None
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while it runs."""
        if self.returncode is None:
            self._server.receive_reports(0.0)
        return self.returncode

    def send_signal(self, sig: int) -> None:
        """Send a signal through the server, which alone knows that the process id still belongs to this process."""
        if self.poll() is None:
            self._server.send_order({"signal": int(sig), "name": self.name})

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the exit code. Raises subprocess.TimeoutExpired after `timeout` seconds."""
        until = None if timeout is None else time.monotonic() + timeout
        while self.poll() is None:
            left = 3600.0 if until is None else until - time.monotonic()
            if left <= 0:
                raise subprocess.TimeoutExpired(self.name, timeout or 0.0)
            self._server.receive_reports(left)
        assert self.returncode is not None
        return self.returncode


def forkserver_command(package: str, out: Path, preload: Sequence[str]) -> tuple[str, ...]:
    """Return the command line of the forkserver of `package`, which imports the modules `preload` before it forks."""
    loads = [word for module in preload for word in ("--preload", module)]
    command = (sys.executable, "-P", "-m", "deploy.run.forkserver", "--of", package)
    return (*command, f"--out={out.absolute()}", "--parent", str(os.getpid()), *loads)
