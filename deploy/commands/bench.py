"""`overfly bench NAME`: measure this machine; each figure beside its reference of the same run."""

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
    """One row: its name, the module with `add_arguments(parser)` and `measure(args) -> list[Row]`, one line of help,
    and the extras that it needs."""

    name: str
    module: str
    about: str
    needs: tuple[str, ...] = ()


WITH_LEARNER = (extras.LEARNER,)
BENCHES: tuple[Bench, ...] = (
    Bench("rollout", "deploy.bench.rollout", "UAV steps a second of N processes against the fleet in one process"),
    Bench("journal", "deploy.bench.journal", "what the TMC's journal takes, a commit costs, and a UAV step leaves"),
    Bench("learner", "deploy.bench.learner", "updates a second of a running mission against the textbook loop",
          WITH_LEARNER),
    Bench("startup", "deploy.bench.startup", "seconds to the first update, to a UAV's first word, and of imports",
          WITH_LEARNER),
    Bench("memory", "deploy.bench.memory", "memory of all processes of a training, by role, and of the replay memory",
          WITH_LEARNER),
    Bench("train", "deploy.bench.train", "ticks a second of the whole recipe, start and memory, for some team sizes",
          WITH_LEARNER),
    Bench("replay", "deploy.bench.replay", "bytes a transition, milliseconds a minibatch, inserts a second"),
    Bench("actor", "deploy.bench.actor", "a whole UAV step against the bare call of ONNX Runtime", WITH_LEARNER),
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    names = parser.add_subparsers(dest="bench", required=True, metavar="NAME")
    for bench in BENCHES:
        sub = names.add_parser(bench.name, help=bench.about, description=bench.about)
        sub.add_argument("--json", action="store_true", help="print one line of JSON a figure")
        importlib.import_module(bench.module).add_arguments(sub)


def main(args: argparse.Namespace) -> int:
    """Measure, then print the table, or a line of JSON a figure with the machine and the versions."""
    bench = next(bench for bench in BENCHES if bench.name == args.bench)
    extras.require(*bench.needs)
    facts = machine()
    before = cores.worth()
    try:
        rows = importlib.import_module(bench.module).measure(args)
    except MissionFailed as failed:
        tell(str(failed))
        return FAILED
    except subprocess.CalledProcessError as failed:  # what it had to say stands above
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
