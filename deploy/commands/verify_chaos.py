"""`overfly verify chaos`: its options, and the table of its result."""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

from deploy import extras, policy_spec, settings
from deploy.run.mission import check, needs, new_folder
from deploy.run.progress import clock
from deploy.verify.chaos import trial
from deploy.verify.chaos.faults import CUT, POWER, STOP, Fault, draw_faults
from deploy.verify.chaos.schedule import FaultSchedule
from tmc.center.roster import LEARNER, uav_name
from tmc.kernel.config import Config, ConfigError
from tmc.wire import process

ABOUT = "kill, stop and cut off the processes of a mission at random, and check that nothing was lost or doubled"
MODES = ("train", "fly")
ROLES = ("tmc", LEARNER, "uav", POWER)


SLOW = {"journal.commit_interval": 1.0, "journal.flush_interval": 1.0}
"""Settings of the counter-check: in a training an acknowledgement comes about 0.2 s after its record, so only a slower
commit makes it too early."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the trial, and those of missions."""
    parser.add_argument("preset", nargs="?", help="settings to start from (default: quick, or paper with --mode fly)")
    parser.add_argument("--mode", choices=MODES, default="train", help="a training, or missions of a fixed pilot that "
                        "must end as they do in lock step (default: train)")  # fmt: skip
    parser.add_argument("--kills", type=int, default=200, metavar="K", help="kills (kill -9) in total (default: 200)")
    parser.add_argument("--fault-seed", type=int, default=1, metavar="S", help="seed of the faults (default: 1)")
    parser.add_argument("--who", default="planner:greedy", help="what flies with --mode fly: policy, run or planner")
    parser.add_argument("--power", action="store_true", help="half of the kills are power cuts; the journal is synced")
    parser.add_argument("--ack-early", action="store_true", help="the counter-check: a TMC that acknowledges too early "
                        "is killed until records are lost; ends with exit code 1")  # fmt: skip
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the run folders and the history there")
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    settings.add_options(parser)


def main(args: argparse.Namespace, show_progress: Callable[[str], None], clear: Callable[[], None]) -> int:
    """Run the trial; return exit code 1 if there is a violation. Raises ConfigError."""
    config, policy = _config(args)
    extras.require(*needs(config, policy))
    faults = _faults(args, config)
    place = Path(tempfile.mkdtemp(prefix="overfly-chaos-")) if args.keep is None else new_folder(args.keep, "chaos")
    schedule = FaultSchedule(faults, show_progress, place / "history.txt", until_loss=args.ack_early)
    start = time.monotonic()
    try:
        result = trial.run(config, policy, place, schedule, trains=args.mode == "train")
    except KeyboardInterrupt:
        clear()
        if args.keep is None:
            shutil.rmtree(place)
        raise
    clear()
    passed = not result.violations
    kept = "" if passed and args.keep is None else str(place)
    if not kept:
        shutil.rmtree(place)
    seconds = time.monotonic() - start
    if args.json:
        print(json.dumps(as_json(result, seconds) | {"folder": kept}), flush=True)
    else:
        print("\n".join([*table(result), "", *conclusion(result, seconds, kept, early=args.ack_early)]), flush=True)
    return process.DONE if passed else process.FAILED


def _config(args: argparse.Namespace) -> tuple[Config, bytes | None]:
    """Return the settings of the trial, and the fixed policy if one flies. Raises ConfigError."""
    if args.kills < 1:
        raise ConfigError("--kills must be 1 or more")
    more: dict[str, Any] = {"trial.ack_early": args.ack_early}
    more |= {"journal.durability": "power"} if args.power else {}
    more |= SLOW if args.ack_early else {}
    if args.mode == "train":
        config = settings.config_for(args.preset or "quick", {**trial.TRAIN, **more, **settings.chosen(args)})
        return config, None
    pilot = policy_spec.resolve(args.who)
    values = policy_spec.mission_values(pilot, trial.FLY, more, settings.chosen(args))
    return settings.config_for(args.preset or "paper", values), pilot.policy


def _faults(args: argparse.Namespace, config: Config) -> list[Fault]:
    world = check(config)
    team = [uav_name(i) for i in range(world.config.team.size)]
    names = ["tmc"] if args.ack_early else ["tmc", *([LEARNER] if args.mode == "train" else []), *team]
    return draw_faults(args.kills, args.fault_seed, names, power=args.power)


def all_recoveries(schedule: FaultSchedule) -> list[float]:
    """Return the time (s) of each recovery, of all roles."""
    return [took for role in ROLES for took in schedule.recoveries[role]]


def table(result: trial.TrialResult) -> Iterator[str]:
    """Yield the lines of the table: faults, recoveries and counts."""
    schedule = result.schedule
    yield f"{'killed':<14} {'times':>6} {'recovered':>10} {'median':>9} {'worst':>9}"
    lines = [(role, schedule.kills[role], schedule.recovered[role], schedule.recoveries[role]) for role in ROLES]
    lines += [("all", sum(schedule.kills.values()), sum(schedule.recovered.values()), all_recoveries(schedule))]
    for role, kills, recovered, took in lines:
        if kills:
            times = f"{median(took):>7.2f} s {max(took):>7.2f} s" if took else f"{'-':>9} {'-':>9}"
            yield f"{'power cut' if role == POWER else role:<14} {kills:>6} {recovered:>10} {times}"
    rows = [("processes stopped", schedule.count(STOP)), ("connections cut", schedule.count(CUT))]
    rows += [("journal cut, bytes", schedule.bytes_cut)] if schedule.kills[POWER] else []
    rows += [("missions", result.missions)]
    rows += [(name, result.total(name)) for name in ("episodes", "ticks", "updates")]
    rows += [(f"records {what}", result.total(what)) for what in ("journalled", "acknowledged", "lost")]
    rows += [("records applied twice", result.total("doubled")), ("facts checked", result.facts)]
    yield ""
    yield from (f"{name:<22} {value:>12,}" for name, value in rows)


def conclusion(result: trial.TrialResult, seconds: float, kept: str, *, early: bool) -> Iterator[str]:
    """Yield the result in sentences."""
    kills, lost = sum(result.schedule.kills.values()), result.total("lost")
    if early:
        yield (f"acknowledged too early, {lost:,} records were lost: the trial detects losses"
               if lost else "acknowledged too early, but no loss was found: choose more --kills")  # fmt: skip
    elif not result.violations:
        yield f"{kills} kills in {clock(seconds)}: nothing was lost, nothing doubled, all processes recovered"
    yield from (f"overfly: {violation}" for violation in result.violations)
    if kept:
        yield f"run folders and history are in {kept}"


def as_json(result: trial.TrialResult, seconds: float) -> dict[str, Any]:
    """Return all of the table, for JSON."""
    schedule = result.schedule
    counts = ("episodes", "ticks", "updates", "journalled", "acknowledged", "lost", "doubled")
    return {
        "kills": dict(schedule.kills), "recovered": dict(schedule.recovered), "stops": schedule.count(STOP),
        "cuts": schedule.count(CUT),
        "recovery": {role: {"median": round(median(took), 3), "worst": round(max(took), 3)}
                     for role, took in (*schedule.recoveries.items(), ("all", all_recoveries(schedule))) if took},
        "missions": result.missions, **{name: result.total(name) for name in counts}, "facts": result.facts,
        "bytes_cut": schedule.bytes_cut, "violations": result.violations, "seconds": round(seconds, 1),
    }  # fmt: skip
