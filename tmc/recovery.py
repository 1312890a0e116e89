"""Recovery by replay: the journal, played through the station, gives the state of the TMC that wrote it.

Only what came from outside is taken from the journal: flight records, policies, who was lost, when episodes began and
how far the learner was. Everything else follows, and what a kill kept from being written is written then.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from tmc.entries import Entry
from tmc.flight import RefusedError
from tmc.journal import policy_path
from tmc.record.builders import to_record
from tmc.record.errors import RecordError
from tmc.record.reader import Entry as Logged
from tmc.record.reader import Log
from tmc.station import Station


def recover(station: Station, path: Path, now: float) -> list[Entry]:
    """Bring a new station to the state that the journal at `path` tells of; returns what is missing in the journal.

    RecordError when the journal contradicts itself, or is of another mission.
    """
    station.playing = True
    try:
        missing = play(station, Log(path).entries(), path.parent, now)
    finally:
        station.playing = False
    for member in station.roster:
        member.durable = member.sequence
    station.feed.recovered = True
    station.out.take()
    return missing


def play(station: Station, journal: Iterable[Logged], folder: Path, now: float) -> list[Entry]:
    """Play entries of a journal; returns those that follow from them and are not among them."""
    written: Counter[str] = Counter()
    made: list[Entry] = []
    for logged in journal:
        written[logged.topic] += 1
        taker = _TAKERS.get(logged.message.DESCRIPTOR.name)
        if taker is not None:
            try:
                taker(station, logged.message, folder, now)
            except RefusedError as refused:
                raise RecordError(f"the journal contradicts itself, so do not go on with it: {refused}") from None
            made += station.out.take().entries
    missing = []
    for entry in made:
        written[entry.topic] -= 1
        if written[entry.topic] < 0:
            missing.append(entry)
    return missing


def _episode(station: Station, message: Any, _folder: Path, _now: float) -> None:
    begun = station.flight is not None and station.flight.episode == message.episode
    if message.phase == "begin" and not begun:
        if station.flight is not None or station.episodes != message.episode - 1:
            raise RecordError(f"the journal begins episode {message.episode} out of turn: do not go on with it")
        station.begin_episode([])


def _record(station: Station, message: Any, _folder: Path, now: float) -> None:
    record, flight = to_record(message), station.flight
    member = station.roster[record.uav]
    if flight is None or record.episode != flight.episode or record.sequence != member.sequence:
        raise RecordError(f"the journal has record {record.sequence} of UAV {record.uav} out of turn: do not go on")
    member.live(record.life, now)
    station.accept(flight, record)


def _lost(station: Station, message: Any, _folder: Path, _now: float) -> None:
    if station.flight is not None and message.uav not in station.flight.lost:
        station.lose(station.flight, message.uav)
        station.go_on(station.flight)


def _policy(station: Station, message: Any, folder: Path, _now: float) -> None:
    if message.version > station.policies.newest:
        station.take_policy(message.version, _model(message, folder), message.updates, message.loss)


def _model(message: Any, folder: Path) -> bytes:
    """The policy file, if it is still there and whole."""
    try:
        model = bytes(message.model) or policy_path(folder, message.version).read_bytes()
    except OSError:
        return b""
    return model if hashlib.sha256(model).hexdigest() == message.sha256 else b""


def _metrics(station: Station, message: Any, _folder: Path, _now: float) -> None:
    station.limiter.updates = message.updates


_TAKERS: dict[str, Callable[[Station, Any, Path, float], None]] = {
    "Episode": _episode,
    "FlightRecord": _record,
    "Lost": _lost,
    "Policy": _policy,
    "TeamMetrics": _metrics,
}
