"""`overfly tmc PRESET`: runs the TMC; UAVs and the learner connect to it from this host or others."""

from __future__ import annotations

import argparse
from pathlib import Path

from deploy import extras, policy_spec, settings
from deploy.run import machine, mission
from deploy.run.progress import Progress
from tmc.__main__ import serve
from tmc.kernel.config import Config, ConfigError, build
from tmc.kernel.text import printable
from tmc.record.errors import RecordError
from tmc.record.mcap.compact import compact_log
from tmc.record.run_folder import RunFolder
from tmc.wire.process import DONE, tell
from tmc.wire.sockets import check_free


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("preset", nargs="?", default="paper", help="settings to start from (default: paper)")
    parser.add_argument("--bind", default="tcp://127.0.0.1:5555", metavar="ENDPOINT",
                        help="endpoint for UAVs; the learner uses the next port (default: %(default)s)")  # fmt: skip
    parser.add_argument("--fly", metavar="POLICY", help="fly a fixed policy or a planner; there is no learner")
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder (default: runs/tmc-<time>)")
    parser.add_argument("--resume", type=Path, metavar="RUN", help="resume the mission whose journal is there")
    settings.add_options(parser)


def main(args: argparse.Namespace) -> int:
    """Serve until the mission is over; return the exit code. Raises ConfigError."""
    extras.require()
    check_free(args.bind)
    if args.resume is not None:
        return resume(args)
    config = settings.config_for(args.preset, settings.chosen(args))
    policy, name = None, ""
    if args.fly:
        pilot = policy_spec.resolve(args.fly)
        config = build(policy_spec.mission_values(pilot, settings.chosen(args)), config)
        policy, name = pilot.policy, pilot.name
    world = mission.check(config, policy, name)
    learns = policy is None and not policy_spec.is_planner(config)
    if not name:
        mission.check_training(config)
    machine.require(config, learns=learns, alone=True, out=args.out or Path())
    out = mission.new_folder(args.out, "tmc")
    path = mission.keep_settings(out, world, policy)
    print(f"overfly: the TMC is at {args.bind}; connect {config.team.size} UAVs; log in {printable(out)}", flush=True)
    return _compact(serve(config, args.bind, out, policy=path, tracks=""), config, out)


def resume(args: argparse.Namespace) -> int:
    """Resume a mission whose TMC was killed or stopped; return the exit code. Raises ConfigError.

    UAVs and learner of a killed TMC find this one by themselves; a stopped TMC has ended them.
    """
    if args.out or args.fly or settings.chosen(args):
        raise ConfigError("--resume uses the mission's own settings: give it nothing but --bind")
    world, policy = mission.interrupted(args.resume)
    path = mission.flown_policy(args.resume) if policy is not None else None
    learns = policy is None and not policy_spec.is_planner(world.config)
    machine.require(world.config, learns=learns, alone=True, out=args.resume)
    print(f"overfly: the TMC is at {args.bind} again, with the journal in {printable(args.resume)}", flush=True)
    code = serve(world.config, args.bind, args.resume, policy=path, tracks="", resume=True)
    return _compact(code, world.config, args.resume)


def _compact(code: int, config: Config, out: Path) -> int:
    """Compact the journal of a TMC whose mission is over; return its exit code."""
    if code == DONE:
        try:
            compacted = compact_log(RunFolder(out).journal, Progress(config, 1, 0.0).work)
            print(f"overfly: the log is compacted: {compacted.before:,} bytes before, {compacted.after:,} after")
        except RecordError as error:
            tell(f"the log was not compacted: {error}")
    return code
