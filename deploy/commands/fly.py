"""`overfly fly WHO`: a mission with a fixed policy or a planner in real processes; deterministic."""

from __future__ import annotations

import argparse

from deploy import extras, policy_spec, settings
from deploy.commands.analyze import report
from deploy.commands.run import add_mission_options
from deploy.run import mission, plan
from tmc.kernel.config import build


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("who", help="policy file, run folder, or planner:random, planner:random-road, planner:greedy")
    settings.add_options(parser, defaults=policy_spec.ONE_EPISODE)
    add_mission_options(parser)


def main(args: argparse.Namespace) -> int:
    """Fly, then say how it went. One episode unless --episodes says otherwise; the paper's settings otherwise."""
    extras.require()
    pilot = policy_spec.resolve(args.who)
    values = policy_spec.mission_values(pilot, settings.chosen(args))
    world = mission.check(build(values), pilot.policy, pilot.name)
    if not args.lockstep:
        plan.check_machine(world.config, learns=False, out=args.out)
    out = mission.new_folder(args.out, "fly")
    flight = mission.Mission(world, out, mission.command_line(), pilot.policy, flies=pilot.name)
    code = flight.run(in_one_process=args.lockstep)
    return code or report(out, as_json=args.json, pictures=not args.no_pictures)
