"""The command `overfly`: one table of subcommands. A module is imported only when its command is chosen."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from tmc.wire import process
from tmc.wire.options import Options


@dataclass(frozen=True)
class Command:
    """One row: its name, the module with `add_arguments(parser)` and `main(args) -> int`, and one line of help."""

    name: str
    module: str
    about: str


COMMANDS: tuple[Command, ...] = (
    Command("run", "deploy.commands.run", "train: spawn TMC, learner and N UAVs, and look after them"),
    Command("fly", "deploy.commands.fly", "fly a mission with a fixed policy or a planner, no learner"),
    Command("evaluate", "deploy.commands.evaluate", "compare policies and planners over many seeds"),
    Command("verify", "deploy.commands.verify", "put to the test: exactness, asynchrony, chaos"),
    Command("bench", "deploy.commands.bench", "measure this machine: speed, start, memory, each beside a reference"),
    Command("analyze", "deploy.commands.analyze", "a run's summary and pictures, from its log"),
    Command("log", "deploy.commands.log", "a run's logs: read, check, recover, compact, merge, replay"),
    Command("map", "deploy.commands.map", "the maps: list, show, export, check"),
    Command("tmc", "deploy.commands.tmc", "the TMC alone, for roles started by hand or on other hosts"),
    Command("actor", "deploy.commands.actor", "one UAV alone"),
    Command("learner", "deploy.commands.learner", "the learner alone"),
    Command("doctor", "deploy.commands.doctor", "check this machine, the install, and list the settings"),
)


def mistakes() -> tuple[type[Exception], ...]:
    """The errors that are the user's to fix: one sentence and exit code 2."""
    from tmc.kernel.config import ConfigError  # noqa: PLC0415  the command starts without NumPy
    from tmc.kernel.policy import PolicyError  # noqa: PLC0415
    from tmc.kernel.roadmap import MapError  # noqa: PLC0415
    from tmc.record.errors import RecordError  # noqa: PLC0415
    from tmc.wire.sockets import EndpointError  # noqa: PLC0415

    return ConfigError, PolicyError, MapError, RecordError, EndpointError, MemoryError


class _Version(argparse.Action):
    """Looks the version up only when it is asked for: that takes as long as all else at the start of the command."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version  # noqa: PLC0415

        print(f"overfly {version('overfly')}")
        parser.exit()


def parser_for(chosen: str | None) -> argparse.ArgumentParser:
    """The parser; only the chosen command's module is imported for its options."""
    parser = Options("overfly", description="A team of UAV processes learns to patrol a road network.")
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        sub = commands.add_parser(command.name, help=command.about, description=command.about)
        if command.name == chosen:
            importlib.import_module(command.module).add_arguments(sub)
    return parser


def interrupt(number: int, _frame: FrameType | None) -> None:
    """SIGTERM and SIGHUP end a command in order, as Ctrl-C does."""
    raise KeyboardInterrupt(number)


def discard_output() -> None:
    """Send to nowhere what is left of the output, or the interpreter fails once more when it writes that at its end."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def check_install() -> None:
    """Raise ConfigError unless `overfly.py` and the four packages, whose names are plain, lie side by side."""
    roots = {_folder_of("overfly", 1), *(_folder_of(name, 2) for name in ("actors", "learner", "tmc", "deploy"))}
    if len(roots) > 1:
        from tmc.kernel.config import ConfigError  # noqa: PLC0415

        raise ConfigError(f"the packages of Overfly lie in different folders ({', '.join(sorted(roots))}): reinstall")


def _folder_of(name: str, depth: int) -> str:
    """The folder that a module or a package lies in, `depth` steps above its file."""
    spec = importlib.util.find_spec(name)
    return str(Path(spec.origin).resolve().parents[depth - 1]) if spec and spec.origin else f"no {name}"


def main(argv: list[str] | None = None, trial: Mapping[str, Any] | None = None) -> int:
    """Run one command; returns the exit code.

    `trial`: settings `trial.*` of the mission. They stall UAVs or lose data by design, so no option sets them.
    """
    process.standard_streams()
    process.inherited_signals()
    try:
        return _main(argv, trial or {})
    except Exception as error:
        from deploy import extras  # noqa: PLC0415  only where something is wrong

        sentence = extras.broken(error)
        if not sentence:
            raise
        process.tell(sentence)
        return process.USAGE


def _main(argv: list[str] | None, trial: Mapping[str, Any]) -> int:
    # While modules are imported nothing is worth an orderly end: Ctrl-C ends the process, without a traceback.
    process.handle(signal.SIGINT, signal.SIG_DFL)
    argv = sys.argv[1:] if argv is None else argv
    chosen = next((a for a in argv if not a.startswith("-")), None)
    args = parser_for(chosen).parse_args(argv)
    args.trial = dict(trial)
    module = importlib.import_module(next(c.module for c in COMMANDS if c.name == args.command))

    def run() -> int:
        check_install()
        for number in process.ENDING:
            process.handle(number, interrupt)
        code = int(module.main(args))
        sys.stdout.flush()  # what cannot be written shows here, and not when the interpreter ends
        return code

    try:
        return process.run(run, mistakes())
    except KeyboardInterrupt as stopped:
        return 128 + (stopped.args[0] if stopped.args else signal.SIGINT)
    except BrokenPipeError:  # the reader of our output, such as `head`, has seen enough; we are not done, though
        discard_output()
        return 128 + signal.SIGPIPE
    except OSError as error:  # a full disk, a folder that was removed
        from deploy import extras  # noqa: PLC0415  only where something is wrong

        if extras.broken(error):  # a library without another one that it needs
            raise
        discard_output()
        process.tell(f"{error.filename or 'output'}: {error.strerror or error}")
        return process.FAILED


if __name__ == "__main__":
    sys.exit(main())
