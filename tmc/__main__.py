"""`python -m tmc`: the TMC process. `overfly tmc` starts the same with a config made from a preset."""

from __future__ import annotations

import argparse
import json
import sys
import uuid
from pathlib import Path

from tmc.journal import Journal
from tmc.kernel.config import Config, ConfigError, build
from tmc.kernel.roadmap import MapError
from tmc.kernel.world import World
from tmc.record.errors import RecordError
from tmc.service import Service
from tmc.station import Station
from tmc.wire import process
from tmc.wire.sockets import EndpointError

MISTAKES = (ConfigError, MapError, RecordError, EndpointError)


def serve(config: Config, endpoint: str, out: Path, *, policy: Path | None, tracks: str) -> int:
    """Run the TMC of a mission until it is over; returns the exit code. With a fixed policy there is no learner."""
    stop = process.Stop()
    world = World(config)
    run = uuid.uuid4().hex[:12]
    learning = policy is None and config.team.pilot == "policy"
    station = Station(world, run, learning=learning, policy=policy.read_bytes() if policy else None, tracks=tracks)
    out.mkdir(parents=True, exist_ok=True)
    service = Service(station, Journal(out, world, run), endpoint)
    try:
        return process.DONE if service.serve(stop) else stop.code
    finally:
        service.close()


def main(argv: list[str] | None = None) -> int:
    """Parse the options of a child process and serve."""
    parser = argparse.ArgumentParser("tmc", description=__doc__)
    parser.add_argument("--config", type=Path, required=True, help="settings of the mission, JSON")
    parser.add_argument("--bind", required=True, help="endpoint for the UAVs; the learner's lies beside it")
    parser.add_argument("--out", type=Path, required=True, help="run folder")
    parser.add_argument("--policy", type=Path, help="fly this policy file; there is no learner")
    parser.add_argument("--tracks", default="", help="track table that UAVs on this machine share")
    parser.add_argument("--parent", type=int, default=0, help="process to die with")
    a = parser.parse_args(argv)
    process.die_with_parent(a.parent)

    def start() -> int:
        config = build(json.loads(a.config.read_text()))
        return serve(config, a.bind, a.out, policy=a.policy, tracks=a.tracks)

    return process.run(start, MISTAKES)


if __name__ == "__main__":
    sys.exit(main())
