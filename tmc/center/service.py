"""The TMC as a process: sockets and a clock around the station, one loop."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import zmq

from tmc.center import roster
from tmc.center.commit_gate import CommitGate
from tmc.center.journal import Journal
from tmc.center.roster import LEARNER, uav_name
from tmc.center.station import Station
from tmc.wire import process, sockets
from tmc.wire.codec import CodecError, decode
from tmc.wire.messages import Bye, End, PolicyPush, Welcome

MESSAGES_PER_POLL = 64
"""Messages taken from one socket before the other has its turn."""
BATCH_DELAY_S = 0.01
"""Time that book-keeping waits for more of its kind: a dozen records in a row cost a third of one at a time, since the
processor's caches hold the code."""
STALL_THRESHOLD_S = 1.0
"""A loop iteration longer than this does not count as client silence."""
SHUTDOWN_TIMEOUT_S = 60.0
"""Time that the TMC waits for the last client to leave once the mission is over."""
RECONNECT_WINDOW_S = 3.0
"""Time that a restarted TMC waits for clients that may not know yet that the mission is over."""


class Service:
    """Bind both sockets, and serve until the mission is over or `stop` returns True."""

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
        self._gate = CommitGate(station, resumed=journal.found)
        self._waiting: PolicyPush | None = None
        self._ticked = time.monotonic()
        self._reminder = process.Reminder()
        self._unjournalled_since: float | None = None
        """When the oldest entry came that is not journalled (s, monotonic clock)."""

    def serve(self, stop: Callable[[], bool]) -> bool:
        """Run the main loop; return True when the mission came to its end, False when it was stopped."""
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
        """Count the UAVs' silence, without the time for which this process was stopped or waited for a slow disk."""
        now, then = time.monotonic(), self._ticked
        if now - then > STALL_THRESHOLD_S:
            roster.excuse(self.station.roster, now - then, now)
        self._ticked = now
        self.station.tick(now)

    def _remind(self) -> None:
        """Print what the mission waits for, if it has made no progress for some seconds."""
        station = self.station
        progress = (station.phase, station.ticks, station.rate_limiter.updates)
        if self._reminder.due(progress) and (text := self._waits_for()):
            process.note(text)

    def _waits_for(self) -> str:
        if self._over is not None and self._here:
            return f"the mission is over; the TMC waits for {roster.name_some(sorted(self._here))} to leave"
        missing = roster.name_some(self.station.waiting_for())
        return f"the TMC waits for {missing}" if missing else ""

    def _patience(self) -> int:
        """Return the time to wait for a message (ms), short enough that a silence is not noticed late."""
        due = self.journal.due
        if self._unjournalled_since is not None:
            due = self._unjournalled_since + BATCH_DELAY_S - time.monotonic()
        return 100 if due is None else min(100, max(0, math.ceil(1000 * due)))

    def _finalise(self) -> None:
        """Do the book-keeping that no client waits for, and a group commit if one is due.

        Only then are records acknowledged, with the answers to later ones.
        """
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
        """Hand over to the journal everything that was accepted."""
        if self.station.learning:
            self.journal.keep_policies(self.station.policies.held())
        self.journal.take(self.station.out.take_entries())

    def _commit(self) -> None:
        """Commit the journal, which holds everything that was accepted, and so acknowledge all of it."""
        self.journal.commit()
        self.station.committed()
        self._gate.committed()

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
                self.station.committed()  # it is not: a trial must see what follows from that
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
        former = self.station.sample_queue.former
        if isinstance(message, PolicyPush) and sender == LEARNER and message.incarnation not in former:
            self._waiting = message  # replaces an older one that may wait
            self._take_waiting()
        else:
            self.station.answer(sender, message, time.monotonic())

    def _take_waiting(self) -> None:
        push = self._waiting
        if push is not None and self._gate.policy_may_change:
            self._waiting = None
            self.station.answer(LEARNER, push, time.monotonic())

    def _send(self) -> None:
        """Send what the station has for clients.

        The journal may wait: only what is committed is acknowledged, and the commit gate knows the exceptions.
        """
        out = self.station.out
        if self._unjournalled_since is None and (out.entries or out.notes):
            self._unjournalled_since = time.monotonic()
        sends = out.take_sends()
        if self._gate.must_commit(sends):
            self._write()
            self._commit()
        for name, message in sends:
            # A client that was not heard yet may have been connected to an earlier incarnation of this process.
            default = (self.learner_socket if name == LEARNER else self.sync, name.encode())
            sock, identity = self._where.get(name, default)
            sockets.send(sock, message, identity)
            if isinstance(message, Welcome):  # a client that was refused is not waited for
                self._here.add(name)
                self._expected.discard(name)

    def _finished(self) -> bool:
        """Return True when the mission is over, and all clients have left or had time to."""
        if self.station.phase != "done":
            self._over = None  # a learner from an older checkpoint repeats the updates that it lost
            return False
        now = time.monotonic()
        self._over = self._over or now
        return now - self._over >= max(SHUTDOWN_TIMEOUT_S * bool(self._here), RECONNECT_WINDOW_S * bool(self._expected))

    def _say_goodbye(self, reason: str) -> None:
        for sock, identity in self._where.values():
            sockets.send(sock, End(reason=reason), identity)

    def _sum_up(self) -> None:
        """Log how many messages of each type were received."""
        counts = " · ".join(f"{name} {count}" for name, count in sorted(self._taken.items()))
        self.journal.writer.log("info", f"messages taken: {counts}")

    def close(self) -> None:
        """Close the sockets and the journal."""
        self.context.destroy(linger=200)
        for endpoint in (self.endpoint, sockets.learner_endpoint(self.endpoint)):
            sockets.unlink(endpoint)
        self.journal.writer.close()
