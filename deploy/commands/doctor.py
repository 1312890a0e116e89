"""`overfly doctor`: is everything here that a run needs? Also the table of all settings."""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from deploy import extras, settings
from deploy.run import machine, scratch
from deploy.run.forked import ForkServer, forkserver_command
from deploy.run.plan import environment
from tmc.kernel.config import SETTINGS, Config, flat
from tmc.kernel.text import printable
from tmc.kernel.world import World
from tmc.record.reader import Log
from tmc.record.writer import LogWriter
from tmc.wire import process

ANSWER_S, START_S = 10, 60
"""Time that a message, and a process, may take."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "--settings", action="store_true", help="list every setting with its value, range, unit and source"
    )
    parser.add_argument(
        "--preset",
        default="paper",
        help="the preset whose values are listed, or that the machine is looked at for (default: paper)",
    )


def main(args: argparse.Namespace) -> int:
    """Check, a line each; exit code 1 when something that every run needs is wrong."""
    if args.settings:
        return _settings(args.preset)
    fine = True
    for package in extras.packages():
        fine &= _package(package)
    config = settings.config_for(args.preset, {})
    for what, look in CHECKS.items():
        try:
            print(printable(f"  ok    {what}: {look(config)}"))
        except Exception as error:  # whatever is wrong here is what the doctor is for
            fine = False
            print(printable(f"  BAD   {what}: {error}"))
    print("all is well" if fine else "something is wrong: see the lines with BAD")
    return 0 if fine else 1


def _package(package: extras.Package) -> bool:
    """Whether a package can be used; one of an extra may be missing, but not be too old or broken."""
    problem, purpose, fix = package.problem(), extras.PURPOSES[package.name], extras.install(package.extra)
    if not problem:
        try:
            importlib.import_module(package.module)
        except Exception as error:
            fix = extras.broken(error) or f"{package.name} cannot be imported ({error})"
            print(f"  BAD   {fix}")
            return False
        print(f"  ok    {package.name} {version(package.name)}: {purpose}")
        return True
    optional = bool(package.extra) and problem == extras.MISSING
    print(f"  {'none' if optional else 'BAD '}  {package.name} ({problem}): needed for {purpose}; run {fix}")
    return optional


def _world(config: Config) -> str:
    world = World(config)
    return f"{world.map.name}, {world.law.cells.size} road cells, {int(world.map.blocked.sum())} blocked"


def _limits(config: Config) -> str:
    machine.require(config, learns=True)
    return f"enough for a training of {config.team.size} UAVs"


def _shared_folder(config: Config) -> str:
    with scratch.made(config) as shared:
        size = shared.tracks.stat().st_size
    return f"room in {shared.folder.parent} for sockets and a table of {size:,} bytes"


def _sockets(config: Config) -> str:
    import zmq  # noqa: PLC0415  the command starts without ZeroMQ

    from tmc.wire import messages, sockets  # noqa: PLC0415

    with scratch.made(config) as shared, zmq.Context() as context:
        server = sockets.router(context, shared.endpoint)
        client = sockets.dealer(context, shared.endpoint, "observer-doctor")
        sockets.send(client, messages.StatusRequest())
        answered = server.poll(ANSWER_S * 1000)
        server.close()
        client.close()
    if not answered:
        raise RuntimeError(f"a message over ipc did not arrive in {ANSWER_S} s")
    return f"ZeroMQ {zmq.zmq_version()} over ipc"


def _processes(config: Config) -> str:
    """Start a UAV's process as a mission does; all that it does is to print its options."""
    start = time.monotonic()
    with scratch.made(config) as shared:
        log = shared.folder / "uav.txt"
        command = forkserver_command("actors", shared.folder, ())
        server = ForkServer(command, environment("actors", 1), shared.folder / "forkserver.txt")
        try:
            code = server.start("uav-000", ("--help",), log).wait(START_S)
        except subprocess.TimeoutExpired:
            raise RuntimeError(f"a UAV's process did not start in {START_S} s") from None
        finally:
            server.close()
        if code != process.DONE:
            said = "".join(path.read_text("utf-8", "replace") for path in shared.folder.glob("*.txt"))
            raise RuntimeError(f"a UAV's process {process.how_it_ended(code)}: {process.last_error(said)}")
    return f"a UAV's is forked in {time.monotonic() - start:.1f} s"


def _log(config: Config) -> str:
    """Write a log where runs are kept, read it, and leave everything as it was."""
    runs = Path("runs")
    there = runs.exists()
    runs.mkdir(exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix="doctor-", dir=runs) as folder:
            path = Path(folder) / "tmc.mcap"
            with LogWriter(path, "tmc", config.journal, {}) as log:
                log.log("info", "the doctor was here")
            if not Log(path).finished:
                raise RuntimeError(f"{path} cannot be read back")
    finally:
        if not there:
            with suppress(OSError):  # a run has begun in it
                runs.rmdir()
    return f"written and read in {runs.absolute()}"


def _disk(_: Config) -> str:
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    if free < 1:
        raise RuntimeError(f"{free:.1f} GiB free here: a long run logs more than that")
    return f"{free:.0f} GiB free in this folder"


CHECKS: dict[str, Callable[[Config], str]] = {
    "cores": lambda _: f"{os.cpu_count()}",
    "map": _world,
    "limits": _limits,
    "shared folder": _shared_folder,
    "sockets": _sockets,
    "processes": _processes,
    "logs": _log,
    "disk": _disk,
}
"""What a mission does on this machine, each by the functions that missions use."""


def _settings(preset: str) -> int:
    values = flat(settings.config_for(preset, {}))
    for key, setting in SETTINGS.items():
        source = f" [{setting.source}]" if setting.source else ""
        source = " [set by `overfly verify` alone]" if setting.trial else source
        print(f"{key} = {values[key]}\n    {settings.sentence(setting)}{source}")
    return 0
