"""Recovery by replay: the journal, played through the station, gives the state of the TMC that wrote it.

Only what came from outside is read from the journal: flight records, policies, which UAVs were lost, when episodes
began, and how far the learner was. Everything else follows from these. Entries that a kill kept from being written are
written then. Of episodes so old that the replay memory holds nothing of them, only the sums are read.
"""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any

from google.protobuf.message import Message

from tmc.center.entries import JournalEntry
from tmc.center.episode import RefusedError
from tmc.center.journal import policy_path
from tmc.center.roster import Member
from tmc.center.station import Station
from tmc.kernel import files
from tmc.kernel.config import Config
from tmc.record.builders import to_record
from tmc.record.errors import RecordError
from tmc.record.mcap.parser import Message as LoggedMessage
from tmc.record.overfly_pb2 import Episode, FlightRecord, Lost, Policy, Sync, TeamMetrics
from tmc.record.reader import Log, decode

Taker = Callable[[Station, Any, Path, float], None]
EPISODE, POLICY = "overfly.Episode", "overfly.Policy"


def recover(station: Station, path: Path, now: float) -> list[JournalEntry]:
    """Bring a new station to the state that the journal at `path` records; return the entries missing in the journal.

    Raises RecordError if the journal contradicts itself.
    """
    log = Log(path)
    missing = play(station, log.raw(), path.parent, now, skipped(log, station.config))
    for i, member in enumerate(station.roster):
        member.heard = now
        if station.episode is not None and member.incarnation < 0 and i not in station.episode.lost:
            member.incarnation = 0  # its process is not known, since it has flown nothing yet: it may stay silent
    station.sample_queue.recovered = True
    station.committed()
    station.out.take()
    return missing


def play(
    station: Station,
    journal: Iterable[LoggedMessage],
    folder: Path,
    now: float,
    skip: range = range(0),
    watch: Callable[[list[JournalEntry]], None] = lambda _: None,
) -> list[JournalEntry]:
    """Play the messages of a journal; return the entries that follow from them and are not among them.

    `folder` holds the policy files. Of the episodes in `skip` only the sums are read. `watch` gets all entries.
    """
    balance, skipping = _Balance(), False

    def keep() -> None:
        made = station.out.take().entries
        watch(made)
        balance.made(made)

    keep()  # a fixed policy is journalled before any message
    station.playing = True
    try:
        for raw in journal:
            message = decode(raw) if raw.schema in _TOLD else None
            skipping = message.episode in skip if isinstance(message, Episode) else skipping
            if not skipping or raw.schema == POLICY:
                balance.written(raw.topic)
            if message is not None:
                _take(_SUMS if skipping else _TAKERS, station, message, folder, now)
                keep()
        station.finalise()
        keep()
    finally:
        station.playing = False
    return balance.missing()


def _take(takers: dict[str, Taker], station: Station, message: Message, folder: Path, now: float) -> None:
    taker = takers.get(message.DESCRIPTOR.full_name)
    try:
        if taker is not None:
            taker(station, message, folder, now)
    except RefusedError as refused:
        raise RecordError(f"the journal contradicts itself, so do not resume from it: {refused}") from None


class _Balance:
    """Compare, per topic, what the station makes with what is written; both come in the same order."""

    def __init__(self) -> None:
        self._written: Counter[str] = Counter()
        self._made: dict[str, deque[tuple[int, JournalEntry]]] = {}
        self._count = 0

    def written(self, topic: str) -> None:
        if made := self._made.get(topic):
            made.popleft()
        else:
            self._written[topic] += 1

    def made(self, entries: list[JournalEntry]) -> None:
        for entry in entries:
            self._count += 1
            if self._written[entry.topic]:
                self._written[entry.topic] -= 1
            else:
                self._made.setdefault(entry.topic, deque()).append((self._count, entry))

    def missing(self) -> list[JournalEntry]:
        """Return what was made and is not written, in its order."""
        left = sorted((item for made in self._made.values() for item in made), key=lambda item: item[0])
        return [entry for _, entry in left]


# Episodes of which only the sums are read.


def skipped(log: Log, config: Config) -> range:
    """Return the episodes of which nothing is needed: neither transitions of the replay, nor the start of learning."""
    ended, lost = 0, set[int]()
    messages: Iterator[Episode | Lost] = log.messages(Episode, Lost)
    for message in messages:
        if isinstance(message, Lost):
            lost.add(message.episode)
        elif message.phase == "end":
            ended = message.episode
    # Transitions by episode, of one UAV; around a loss some are left out, so such an episode counts as none.
    starts = [0 if e in lost else config.training.ticks for e in range(1, ended + 1)]
    team, needed = config.team.size, config.replay.learn_start
    head = next((e for e, sum_ in enumerate(accumulate(starts), 1) if sum_ * team >= needed), ended)
    kept = config.replay.capacity // team
    tail = next((n for n, sum_ in enumerate(accumulate(reversed(starts)), 1) if sum_ >= max(kept, 1)), ended)
    return range(head + 1, ended - tail + 1)


def _sum_episode(station: Station, message: Episode, _folder: Path, _now: float) -> None:
    if message.phase == "begin":
        return
    _in_turn(station, message)
    blocked = (message.blocked_grid, message.blocked_obstacle, message.blocked_uav)
    station.episodes, station.steps = message.episode, message.steps
    station.ticks += message.ticks
    station.rate_limiter.ticks += message.ticks
    station.rate_limiter.updates = message.updates
    station.blocked += sum(blocked)
    station.blocked_by_uav += message.blocked_uav


def _sum_record(station: Station, message: FlightRecord, _folder: Path, now: float) -> None:
    _next_of(station, message, now).sequence += 1


def _sum_sync(station: Station, message: Sync, _folder: Path, _now: float) -> None:
    station.version = message.version


# Episodes that are played in full.


def _in_turn(station: Station, message: Episode) -> None:
    if station.episode is not None or station.episodes != message.episode - 1:
        raise RecordError(f"the journal has episode {message.episode} out of turn: do not resume from it")


def _next_of(station: Station, message: FlightRecord, now: float) -> Member:
    """Return the member whose next record this is, after noting its process. Raises RecordError if it is not next."""
    team = station.roster
    if message.uav >= len(team) or message.sequence != team[message.uav].sequence:
        text = f"the journal has record {message.sequence} of UAV {message.uav} out of turn: do not resume from it"
        raise RecordError(text)
    member: Member = team[message.uav]
    member.heard_from(message.incarnation, now)
    return member


def _episode(station: Station, message: Episode, _folder: Path, _now: float) -> None:
    begun = station.episode is not None and station.episode.number == message.episode
    if message.phase == "begin" and not begun:
        _in_turn(station, message)
        station.begin_episode([])
    elif message.phase == "end":
        station.finalise()


def _record(station: Station, message: FlightRecord, _folder: Path, now: float) -> None:
    record, episode = to_record(message), station.episode
    _next_of(station, message, now)
    if episode is None or record.episode != episode.number:
        raise RecordError(f"the journal has a record of episode {record.episode} out of turn: do not resume from it")
    station.accept(episode, record)


def _lost(station: Station, message: Lost, _folder: Path, _now: float) -> None:
    episode, uav = station.episode, message.uav
    if episode is not None and uav < episode.N and uav not in episode.lost:
        station.lose(episode, uav)


def _policy(station: Station, message: Policy, folder: Path, _now: float) -> None:
    if message.version > station.policies.newest:
        station.take_policy(message.version, _model(message, folder), message.updates, message.loss)


def _model(message: Policy, folder: Path) -> bytes:
    """Return the policy file; empty if it is gone or damaged."""
    try:
        model = bytes(message.model) or files.read_bytes(policy_path(folder, message.version))
    except OSError:
        return b""
    return model if hashlib.sha256(model).hexdigest() == message.sha256 else b""


def _metrics(station: Station, message: TeamMetrics, _folder: Path, _now: float) -> None:
    station.finalise()  # the TMC did so here; in between it may have accepted any number of records
    station.rate_limiter.updates = message.updates


_TAKERS: dict[str, Taker] = {
    EPISODE: _episode,
    POLICY: _policy,
    "overfly.FlightRecord": _record,
    "overfly.Lost": _lost,
    "overfly.TeamMetrics": _metrics,
}
_SUMS: dict[str, Taker] = {
    EPISODE: _sum_episode,
    POLICY: _policy,
    "overfly.FlightRecord": _sum_record,
    "overfly.Sync": _sum_sync,
}
_TOLD = _TAKERS.keys() | _SUMS.keys()
