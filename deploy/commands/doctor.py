"""`overfly doctor`: is everything here that a run needs? Also the table of all settings."""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from deploy import extras, settings
from tmc.kernel.config import SETTINGS, flat
from tmc.kernel.text import printable
from tmc.kernel.world import World


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--settings", action="store_true", help="list every setting with its default and source")
    parser.add_argument("--preset", default="paper", help="the preset whose values are listed (default: paper)")


def main(args: argparse.Namespace) -> int:
    """Check, a line each; exit code 1 when something that every run needs is wrong."""
    if args.settings:
        return _settings(args.preset)
    fine = True
    for package in extras.packages():
        fine &= _package(package)
    for what, look in CHECKS.items():
        try:
            print(printable(f"  ok    {what}: {look()}"))
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


def _world() -> str:
    world = World(settings.config_for("paper", {}))
    return f"{world.map.name}, {world.law.cells.size} road cells, {int(world.map.blocked.sum())} blocked"


def _sockets() -> str:
    import zmq  # noqa: PLC0415  the command starts without ZeroMQ

    from tmc.wire import messages, sockets  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder, zmq.Context() as context:
        endpoint = f"ipc://{folder}/s"
        server, client = sockets.router(context, endpoint), sockets.dealer(context, endpoint, "observer-doctor")
        sockets.send(client, messages.StatusRequest())
        answered = server.poll(2000)
        server.close()
        client.close()
    if not answered:
        raise RuntimeError("a message over ipc did not arrive in 2 s")
    return f"ZeroMQ {zmq.zmq_version()} over ipc"


def _disk() -> str:
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    if free < 1:
        raise RuntimeError(f"{free:.1f} GiB free here: a long run logs more than that")
    return f"{free:.0f} GiB free in this folder"


CHECKS: dict[str, Callable[[], str]] = {
    "cores": lambda: f"{os.cpu_count()}",
    "map": _world,
    "sockets": _sockets,
    "disk": _disk,
}


def _settings(preset: str) -> int:
    values = flat(settings.config_for(preset, {}))
    for key, s in SETTINGS.items():
        unit = f" {s.unit}" if s.unit else ""
        source = f" [{s.source}]" if s.source else ""
        print(f"{key} = {values[key]}{unit}\n    {s.about}{source}")
    return 0
