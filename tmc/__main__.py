"""`python -m tmc`: the TMC process. `overfly tmc` starts the same with a config made from a preset."""

from __future__ import annotations

import json
import sys
import time
import uuid
from pathlib import Path

from tmc.center.journal import Journal, journal_in
from tmc.center.recovery import recover
from tmc.center.roster import Outbox
from tmc.center.service import Service
from tmc.center.station import Station
from tmc.kernel import files
from tmc.kernel.config import Config, ConfigError, build
from tmc.kernel.roadmap import MapError
from tmc.kernel.world import world_of_run
from tmc.record.errors import RecordError
from tmc.record.reader import Log
from tmc.wire import capacity, process
from tmc.wire.fields import FieldError
from tmc.wire.options import Options
from tmc.wire.sockets import EndpointError

MISTAKES = (ConfigError, MapError, RecordError, EndpointError, FieldError, MemoryError)


def serve(config: Config, endpoint: str, out: Path, *, policy: Path | None, tracks: str, resume: bool = False) -> int:
    """Run the TMC of a mission until it is over; returns the exit code. With a fixed policy there is no learner.

    `resume`: go on with the journal in `out`, if there is one.
    """
    stop = process.Stop()
    world = world_of_run(config, out)
    run = (run_of(out, config) if resume else None) or uuid.uuid4().hex[:12]
    learning = policy is None and config.team.controller == "policy"
    capacity.check(world, learning=learning)
    model = files.read_bytes(policy) if policy else None
    station = Station(world, run, learning=learning, policy=model, tracks=tracks)
    out.mkdir(parents=True, exist_ok=True)
    journal = Journal(out, world, run, resume=resume)
    if journal.found:
        take_up(station, journal)
    service = Service(station, journal, endpoint)
    try:
        return process.DONE if service.serve(stop) else stop.code
    finally:
        service.close()


def run_of(out: Path, config: Config) -> str | None:
    """The run whose journal lies in `out`, None when there is none; ConfigError if it has other settings."""
    found = journal_in(out)
    if found is None:
        return None
    log = Log(found)
    was = next((json.loads(a.data) for a in log.attachments() if a.name == "config.json"), None)
    if was is not None and build(was) != config:
        raise ConfigError(f"{out} holds the journal of a mission with other settings: choose another --out")
    return log.metadata().get("run")


def take_up(station: Station, journal: Journal) -> None:
    """Play the journal that an earlier incarnation left, and write what is missing in it."""
    start = time.monotonic()
    missing = recover(station, journal.writer.active, start)
    for member in station.roster:
        member.heard = time.monotonic()  # no client could be heard while the journal was played
    journal.take(Outbox(entries=missing))
    journal.commit()
    seconds, episode = time.monotonic() - start, station.episode
    where = f"tick {episode.done} of episode {episode.number}" if episode else f"the end of episode {station.episodes}"
    journal.writer.log("warning", f"the TMC was started again and goes on from {where}; recovery took {seconds:.2f} s")


def main(argv: list[str] | None = None) -> int:
    """Parse the options of a child process and serve."""
    parser = Options("tmc", description=__doc__)
    parser.add_argument("--config", type=Path, required=True, help="settings of the mission, JSON")
    parser.add_argument("--bind", required=True, help="endpoint for the UAVs; the learner's lies beside it")
    parser.add_argument("--out", type=Path, required=True, help="run folder")
    parser.add_argument("--policy", type=Path, help="fly this policy file; there is no learner")
    parser.add_argument("--tracks", default="", help="track table that UAVs on this machine share")
    parser.add_argument("--resume", action="store_true", help="go on with the journal in the run folder")
    parser.add_argument("--parent", type=int, default=0, help="process to die with")
    a = parser.parse_args(argv)
    process.become_child(a.parent)

    def start() -> int:
        config = build(json.loads(files.read_text(a.config)))
        return serve(config, a.bind, a.out, policy=a.policy, tracks=a.tracks, resume=a.resume)

    return process.run_child(start, MISTAKES)


if __name__ == "__main__":
    sys.exit(main())
