"""`overfly verify`: checks that processes fly what lock step flies, wait only where needed, and survive kills."""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from deploy import extras, policy_spec, settings
from deploy.commands import verify_chaos
from deploy.run.line import Line
from deploy.run.mission import check, new_folder
from deploy.run.progress import clock
from deploy.verify import asynchrony, exactness
from tmc.kernel.config import SETTINGS, Config, ConfigError
from tmc.wire import process

PHASES = ("together", "staggered")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    kinds = parser.add_subparsers(dest="check", required=True, metavar="CHECK")
    about = "fly missions as processes and in lock step, and compare every fact of their logs"
    exact = kinds.add_parser("exactness", help=about, description=about)
    exact.add_argument("--actors", dest="teams", default="1,2,3,10", metavar="N[,N...]", help="default: %(default)s")
    exact.add_argument("--scenarios", default="1,2", metavar="S[,S]", help="default: %(default)s")
    exact.add_argument("--tu", dest="periods", default="1,5,10,20", metavar="T[,T...]", help="default: %(default)s")
    exact.add_argument("--phases", default=",".join(PHASES), metavar="P[,P]", help="default: %(default)s")
    exact.add_argument("--seeds", type=int, default=1, metavar="S", help="missions of each kind (default: 1)")
    exact.add_argument("--stalls", action="store_true", help="stall the UAVs at random ticks for some milliseconds")
    ticks, world = (settings.help_of(SETTINGS[key], SETTINGS[key].default) for key in ("training.ticks", "world.map"))
    exact.add_argument("--ticks", metavar="T", help=ticks)
    exact.add_argument("--map", metavar="NAME", help=world)
    _add_common(exact)
    about = "delay one UAV, and show how far the others run ahead of it, and what bounds them"
    asynchronous = kinds.add_parser("asynchrony", help=about, description=about)
    asynchronous.add_argument("--actors", type=int, default=3, metavar="N", help="default: %(default)s")
    asynchronous.add_argument(
        "--hold", type=float, default=0.1, metavar="S", help="delay in seconds per tick (default: 0.1)"
    )
    _add_common(asynchronous)
    about = verify_chaos.ABOUT
    verify_chaos.add_options(kinds.add_parser("chaos", help=about, description=about))


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--who", default="planner:greedy", help="what flies: policy file, run folder, or planner")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="changes", help="any setting")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the logs of missions that differ")
    parser.add_argument("--json", action="store_true", help="print one line of JSON per row")


def main(args: argparse.Namespace) -> int:
    """Verify; return exit code 1 if a check fails. Raises ConfigError."""
    extras.require()
    try:
        return MAINS[args.check](args)
    except exactness.MissionAborted as aborted:
        process.tell(str(aborted))
        return process.FAILED


@contextmanager
def _workplace(out: Path | None) -> Iterator[Path]:
    """Yield a folder for logs: `out`, or a temporary one. It is removed if it is empty at the end."""
    folder = Path(tempfile.mkdtemp(prefix="overfly-verify-")) if out is None else new_folder(out, "verify")
    try:
        yield folder
    finally:
        if not any(folder.iterdir()):
            folder.rmdir()


def listed(option: str, text: str, choices: tuple[str, ...] = ()) -> list[str]:
    """Return the items of a list such as `1,3,10`. Raises ConfigError for one that is not a number or a choice."""
    items = [item.strip() for item in text.split(",")]
    for item in items:
        if not (item in choices if choices else item.isdecimal()):
            known = ", ".join(choices) if choices else "numbers"
            raise ConfigError(f"{option} {text}: '{item}' is not valid; list {known}, separated by commas")
    return items


# Exactness.


def _exactness(args: argparse.Namespace) -> int:
    configs, policy = _configs(args)
    if not args.json:
        print(HEAD, flush=True)
    line, start, steps, facts = Line(), time.monotonic(), 0, 0
    with _workplace(args.out) as place:
        for number, config, share in exactness.with_progress(configs):
            spent = time.monotonic() - start
            left = f" · {clock(spent / share * (1 - share))} left" if share else ""
            line.show(f"mission {number} of {len(configs)}{left}")
            outcome = exactness.verify(config, policy, place / _name(config))
            steps, facts = steps + outcome.steps, facts + outcome.facts
            line.clear()
            _print_row(config, outcome, as_json=args.json)
            if outcome.difference is not None:
                process.tell(f"different: {outcome.difference} (processes against lock step); the logs are in "
                             f"{place / _name(config)}")  # fmt: skip
                return process.FAILED
    if not args.json:
        spent = time.monotonic() - start
        print(f"\n{len(configs)} missions, {steps:,} steps, {facts:,} facts in {clock(spent)}: no difference")
    return process.DONE


def _configs(args: argparse.Namespace) -> tuple[list[Config], bytes | None]:
    """Return every mission to fly, all checked, and the policy that flies. Raises ConfigError."""
    if args.seeds < 1:
        raise ConfigError("--seeds must be 1 or more")
    pilot = policy_spec.resolve(args.who)
    stalls = exactness.STALLS if args.stalls else {}
    base = policy_spec.mission_values(pilot, stalls, settings.chosen(args))
    teams, scenarios, periods = (
        [int(item) for item in listed(option, text)]
        for option, text in (("--actors", args.teams), ("--scenarios", args.scenarios), ("--tu", args.periods))
    )
    phases = listed("--phases", args.phases, PHASES)
    configs = exactness.combinations(base, teams, scenarios, periods, phases, args.seeds)
    for config in configs:
        check(config, pilot.policy)
    return configs, pilot.policy


HEAD = f"{'N':>3} {'scenario':>8} {'T_u':>4} {'phase':<9} {'seed':>5} {'steps':>7} {'facts':>9} {'seconds':>8}  result"


def _print_row(config: Config, outcome: exactness.Outcome, *, as_json: bool) -> None:
    row: dict[str, Any] = {
        "actors": config.team.size, "scenario": config.scenario, "tu": config.T_u, "phase": config.comms.phase,
        "seed": config.training.seed, "steps": outcome.steps, "facts": outcome.facts,
        "seconds": round(outcome.seconds, 1),
    }  # fmt: skip
    if as_json:
        print(json.dumps(row | {"difference": outcome.difference and asdict(outcome.difference)}), flush=True)
        return
    n, scenario, period, phase, seed, steps, facts, seconds = row.values()
    result = "no difference" if outcome.difference is None else "DIFFERENT"
    print(f"{n:>3} {scenario:>8} {period:>4} {phase:<9} {seed:>5} {steps:>7,} {facts:>9,} {seconds:>8.1f}  {result}",
          flush=True)  # fmt: skip


def _name(config: Config) -> str:
    comms = f"tu{config.T_u}-{config.comms.phase}"
    return f"n{config.team.size}-scenario{config.scenario}-{comms}-seed{config.training.seed}"


# Asynchrony.


def _asynchrony(args: argparse.Namespace) -> int:
    if args.actors < 2 or args.hold <= 0:
        raise ConfigError("--actors must be 2 or more, and --hold more than 0, so that one UAV can be ahead of another")
    pilot = policy_spec.resolve(args.who)
    base = policy_spec.mission_values(pilot, settings.chosen(args))
    if not args.json:
        print(f"{args.actors} UAVs, one of them delayed by {args.hold * 1000:g} ms per tick\n\n{asynchrony.HEAD}")
    line, passed = Line(), True
    with _workplace(args.out) as place:
        for number, trial in enumerate(asynchrony.TRIALS, 1):
            line.show(f"flight {number} of {len(asynchrony.TRIALS)}")
            result = asynchrony.fly(trial, args.actors, args.hold, base, pilot.policy, place / f"flight-{number}")
            line.clear()
            print(json.dumps(asdict(result)) if args.json else result.row(), flush=True)
            passed &= result.passed
    return process.DONE if passed else process.FAILED


# Chaos.


def _chaos(args: argparse.Namespace) -> int:
    line = Line()
    return verify_chaos.main(args, line.show, line.clear)


MAINS: dict[str, Callable[[argparse.Namespace], int]] = {
    "exactness": _exactness, "asynchrony": _asynchrony, "chaos": _chaos,
}  # fmt: skip
