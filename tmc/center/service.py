"""The TMC as a process: sockets and a clock around the station, one loop."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import zmq

from tmc.center import roster
from tmc.center.journal import Journal
from tmc.center.roster import LEARNER, uav_name
from tmc.center.station import Station
from tmc.wire import process, sockets
from tmc.wire.codec import CodecError, decode
from tmc.wire.messages import Begin, Bye, End, Lost, Map, Message, PolicyPush, Welcome

MESSAGES_PER_POLL = 64
"""Messages taken from one socket before the other has its turn."""
BATCH_DELAY_S = 0.01
"""Seconds that book-keeping waits for more of its kind: a dozen records in a row cost a third of one at a time, since
the processor has the code at hand."""
STALL_THRESHOLD_S = 1.0
"""Seconds from one turn of the loop to the next from which on nobody is blamed for them."""
SHUTDOWN_TIMEOUT_S = 60.0
"""Seconds that the TMC waits for the last client to leave once the mission is over."""
RECONNECT_WINDOW_S = 3.0
"""Seconds that a TMC that was started again waits to hear of clients that do not know yet that the mission is over."""

MAX_TICKS_UNCOMMITTED = 100
"""Ticks by which answers are ahead of the journal at most, in a training. So a TMC that was started again knows up to
which tick its last incarnation may have answered: up to there it names the policy that that one named."""


def binds(message: Message) -> bool:
    """Whether the UAVs that are told this act on it for good, so that no TMC may come back without it.

    With a new episode they forget where they were in the last one, which a new process that had to fly the last one's
    end would ask them; and those who are told of a loss no longer look out for who is lost.
    """
    return isinstance(message, Lost) or (isinstance(message, Begin) and message.shipped < 0)


class Service:
    """Binds both sockets, and serves until the mission is over or `stop` says so."""

    def __init__(self, station: Station, journal: Journal, endpoint: str) -> None:
        self.station, self.journal, self.endpoint = station, journal, endpoint
        self.context: zmq.Context[Any] = zmq.Context()
        self.sync = sockets.router(self.context, endpoint)
        self.learner_socket = sockets.router(self.context, sockets.learner_endpoint(endpoint))
        self._where: dict[str, tuple[zmq.Socket[Any], bytes]] = {}
        self._here: set[str] = set()
        self._expected = set[str]()
        if journal.found:
            self._expected = {*map(uav_name, range(len(station.roster))), *([LEARNER] if station.learning else [])}
        self._over: float | None = None
        self._taken: Counter[str] = Counter()
        self._flies: dict[str, int] = {}
        """The policy that each UAV was last told to fly; all of that is committed."""
        self._answered = self._committed = 0
        """Up to when UAVs were answered, and up to when that is committed; see `_when`."""
        self._free = self._reached() + MAX_TICKS_UNCOMMITTED if journal.found else 0
        """Up to when UAVs must have been answered before a newer policy is taken."""
        self._waiting: PolicyPush | None = None
        self._ticked = time.monotonic()
        self._reminder = process.Reminder()
        self._unjournalled_since: float | None = None
        """When the oldest entry came that is not journalled, seconds of the monotonic clock."""

    def serve(self, stop: Callable[[], bool]) -> bool:
        """The main loop. True when the mission came to its end, False when it was stopped."""
        poller = zmq.Poller()
        for sock in (self.sync, self.learner_socket):
            poller.register(sock, zmq.POLLIN)
        while not stop():
            for sock, _ in poller.poll(self._patience()):
                self._drain(sock)
            self._tick()
            self._take_waiting()
            self._send()
            self._finalise()
            self._remind()
            self.journal.writer.maybe_flush()
            if self._finished():
                self._sum_up()
                return True
        self._say_goodbye("the TMC was stopped")
        self._sum_up()
        return False

    def _tick(self) -> None:
        """Count the UAVs' silence, without the time in which this process was stopped, or waited for a slow disk."""
        now, then = time.monotonic(), self._ticked
        if now - then > STALL_THRESHOLD_S:
            roster.excuse(self.station.roster, now - then, now)
        self._ticked = now
        self.station.tick(now)

    def _remind(self) -> None:
        """Say for what the mission waits, where it has not gone on for some seconds."""
        station = self.station
        if self._reminder.due((station.phase, station.ticks, station.rate_limiter.updates)) and (
            text := self._waits_for()
        ):
            process.note(text)

    def _waits_for(self) -> str:
        if self._over is not None and self._here:
            return f"the mission is over; the TMC waits for {roster.name_some(sorted(self._here))} to leave"
        missing = roster.name_some(self.station.waiting_for())
        return f"the TMC waits for {missing}" if missing else ""

    def _patience(self) -> int:
        """Milliseconds to wait for a message; not so long that a silence would be seen late."""
        due = (
            self.journal.due
            if self._unjournalled_since is None
            else self._unjournalled_since + BATCH_DELAY_S - time.monotonic()
        )
        return 100 if due is None else min(100, max(0, math.ceil(1000 * due)))

    def _finalise(self) -> None:
        """The book-keeping that nobody waits for, and a group commit where one is due; only then are records
        acknowledged, with the answers to later ones."""
        station, since, due = self.station, self._unjournalled_since, self._commit_due()
        if since is not None and (due or station.finalise_now or time.monotonic() - since >= BATCH_DELAY_S):
            self._unjournalled_since = None
            station.finalise()
            self._send()
            self._write()
            due = self._commit_due()
        if due:
            self._commit()
            self._send()

    def _write(self) -> None:
        """Hand over to the journal whatever was accepted."""
        if self.station.learning:
            self.journal.keep_policies(self.station.policies.held())
        self.journal.take(self.station.out.take_entries())

    def _commit(self) -> None:
        """Commit the journal, in which is whatever was accepted: so all of it is acknowledged."""
        self.journal.commit()
        self.station.committed()
        self._committed = self._answered

    def _commit_due(self) -> bool:
        due = self.journal.due
        return due == 0.0 or (due is not None and self.station.phase == "done")

    def _drain(self, sock: zmq.Socket[Any]) -> None:
        for _ in range(MESSAGES_PER_POLL):
            frames = sockets.receive(sock)
            if frames is None:
                return
            self._take(sock, bytes(frames[0]), frames[1:])
            if self.station.config.trial.ack_early:
                self.station.committed()  # which it is not: a trial must see what comes of that
            self._send()

    def _take(self, sock: zmq.Socket[Any], identity: bytes, frames: list[Any]) -> None:
        sender = sockets.sender_name(identity)
        self._where[sender] = (sock, identity)
        try:
            if len(frames) > sockets.MAX_FRAMES:
                raise CodecError("malformed", f"{len(frames)} frames, at most {sockets.MAX_FRAMES} are taken")
            message = decode(frames)
        except CodecError as error:
            self.station.reject(sender, error.code, str(error))
            return
        self._taken[type(message).__name__] += 1
        if isinstance(message, Bye):
            self._here.discard(sender)
        if (
            isinstance(message, PolicyPush)
            and sender == LEARNER
            and message.incarnation not in self.station.sample_queue.former
        ):
            self._waiting = message  # in the place of one that may wait
            self._take_waiting()
        else:
            self.station.answer(sender, message, time.monotonic())

    def _take_waiting(self) -> None:
        push = self._waiting
        if push is not None and self._may_change:
            self._waiting = None
            self.station.answer(LEARNER, push, time.monotonic())

    @property
    def _may_change(self) -> bool:
        """False while exchanges may be repeated that an earlier incarnation has answered: the same policy must be named
        then.

        True whenever that policy is not at hand, or none will be named any more.
        """
        station = self.station
        over = station.phase in {"learning", "done"}
        return self._answered >= self._free or over or station.policies.find(station.policies.newest) is None

    def _reached(self) -> int:
        """When the next exchange is."""
        episode = self.station.episode
        if episode is None:
            return self._when(self.station.episodes + 1, 0)
        return self._when(episode.number, episode.next_exchange)

    def _when(self, episode: int, tick: int) -> int:
        """Ticks since the mission began, each episode's last one counted."""
        return episode * (self.station.config.training.ticks + 1) + tick

    def _send(self) -> None:
        """Send what the station has for others. The journal can wait, since only what is committed is acknowledged, and
        `_secure` has seen to the policies."""
        out = self.station.out
        if self._unjournalled_since is None and (out.entries or out.notes):
            self._unjournalled_since = time.monotonic()
        sends = out.take_sends()
        self._secure(sends)
        for name, message in sends:
            # PolicySpec was not heard yet may have been connected to an earlier incarnation of this process.
            sock, identity = self._where.get(name) or (
                self.learner_socket if name == LEARNER else self.sync,
                name.encode(),
            )
            sockets.send(sock, message, identity)
            if isinstance(message, Welcome):  # one that was refused is not waited for
                self._here.add(name)
                self._expected.discard(name)

    def _secure(self, sends: list[tuple[str, Message]]) -> None:
        """Commit first what must not be lost once these are sent: see `binds`, and that a UAV was told to fly another
        policy.

        Should the TMC and that UAV be killed, the UAV's next process must be told the same, for peers may have seen
        where the last one went.
        """
        answers = [(name, message) for name, message in sends if isinstance(message, Begin | Map)]
        told = {name: answer.policy for name, answer in answers}
        self._answered = max([self._answered, *(self._when(a.episode, a.tick) for _, a in answers)])
        ahead = self.station.learning and self._answered > self._committed + MAX_TICKS_UNCOMMITTED
        changes = any(self._flies.get(name, 0) != policy for name, policy in told.items())
        if ahead or changes or any(binds(message) for _, message in sends):
            self._write()
            self._commit()
        self._flies |= told

    def _finished(self) -> bool:
        """Over, and everybody has left or was given time to."""
        if self.station.phase != "done":
            self._over = None  # a learner from an older checkpoint makes up for what it lost
            return False
        now = time.monotonic()
        self._over = self._over or now
        return now - self._over >= max(SHUTDOWN_TIMEOUT_S * bool(self._here), RECONNECT_WINDOW_S * bool(self._expected))

    def _say_goodbye(self, reason: str) -> None:
        for sock, identity in self._where.values():
            sockets.send(sock, End(reason), identity)

    def _sum_up(self) -> None:
        """What the radio carried, as one line of the log."""
        counts = " · ".join(f"{name} {count}" for name, count in sorted(self._taken.items()))
        self.journal.writer.log("info", f"messages taken: {counts}")

    def close(self) -> None:
        """Close the sockets and the journal."""
        self.context.destroy(linger=200)
        for endpoint in (self.endpoint, sockets.learner_endpoint(self.endpoint)):
            sockets.unlink(endpoint)
        self.journal.writer.close()
