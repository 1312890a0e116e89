"""`overfly bench NAME`: measures this machine; each figure stands beside a reference of the same run."""

from __future__ import annotations

import argparse
import importlib
import json
import signal
import subprocess
import sys
from dataclasses import asdict, dataclass

from deploy import extras
from deploy.bench import cores
from deploy.bench.row import finite, machine, text
from deploy.run.supervisor import MissionFailed
from tmc.wire import process
from tmc.wire.process import FAILED, tell


@dataclass(frozen=True)
class Bench:
    """One bench: its name, its module, its line of help, and the extras that it needs.

    The module has `add_arguments(parser)` and `measure(args) -> list[Row]`.
    """

    name: str
    module: str
    about: str
    needs: tuple[str, ...] = ()


WITH_LEARNER = (extras.LEARNER,)
BENCHES: tuple[Bench, ...] = (
    Bench("rollout", "deploy.bench.rollout", "UAV steps per second of N processes against the fleet in one process"),
    Bench("journal", "deploy.bench.journal", "rate of the TMC's journal, cost of a commit, bytes per UAV step"),
    Bench("learner", "deploy.bench.learner", "updates per second of a running mission against the textbook loop",
          WITH_LEARNER),
    Bench("startup", "deploy.bench.startup", "seconds to the first update, to a UAV's first message, and of imports",
          WITH_LEARNER),
    Bench("memory", "deploy.bench.memory", "memory of all processes of a training, by role, and of the replay memory",
          WITH_LEARNER),
    Bench("train", "deploy.bench.train", "ticks per second of the whole training, start and memory, by team size",
          WITH_LEARNER),
    Bench("replay", "deploy.bench.replay", "bytes per transition, milliseconds per minibatch, inserts per second"),
    Bench("actor", "deploy.bench.actor", "a whole UAV step against a textbook call of ONNX Runtime", WITH_LEARNER),
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    names = parser.add_subparsers(dest="bench", required=True, metavar="NAME")
    for bench in BENCHES:
        sub = names.add_parser(bench.name, help=bench.about, description=bench.about)
        sub.add_argument("--json", action="store_true", help="print one line of JSON per figure")
        importlib.import_module(bench.module).add_arguments(sub)


def main(args: argparse.Namespace) -> int:
    """Measure, then print the table, or one line of JSON per figure with the machine; return the exit code."""
    bench = next(bench for bench in BENCHES if bench.name == args.bench)
    extras.require(*bench.needs)
    facts = machine()
    before = cores.worth()
    try:
        rows = importlib.import_module(bench.module).measure(args)
    except MissionFailed as failed:
        tell(str(failed))
        return FAILED
    except subprocess.CalledProcessError as failed:  # its own output is above
        code = failed.returncode
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        process.tell(f"a process that was measured {how}")
        return FAILED
    facts["cores_worth"] = [before, cores.worth()]
    if args.json:
        for row in rows:
            print(json.dumps({key: finite(value) for key, value in asdict(row).items()} | facts))
        return 0
    print(text(rows))
    print("\n" + " · ".join(f"{key} {value}" for key, value in facts.items()), file=sys.stderr)
    return 0
