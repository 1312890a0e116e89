"""A UAV as a process: a socket, a clock and a log around one pilot, one loop."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import zmq

from actors.airspace import Tracks, Waiting
from actors.observation_hash import AckLog, ObservationHasher
from actors.pilot import LostRecordsError, Phase, Pilot
from actors.planners import PREFIX, Controller, PlannerController
from actors.radio import RadioTracks
from actors.stalls import Lead, StallingTracks, stalls
from actors.tracks import TableTracks, open_table
from tmc.kernel.config import build
from tmc.kernel.files import plain
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.world import world_of_run
from tmc.record.builders import location_fix
from tmc.record.channels import ACTIVE, uav_topic
from tmc.record.reader import Log
from tmc.record.schemas import UavStatus
from tmc.record.writer import LogWriter
from tmc.wire import messages as m
from tmc.wire import process, sockets
from tmc.wire.codec import CodecError

RETRY_BACKOFF_S = (0.25, 0.5)
"""Seconds after which a message that was not answered goes out again: at first, and at most; doubles in between."""
ASK_INTERVAL_S = 0.2
"""Seconds after which a UAV that waits for a peer's beacon asks for it, and asks again."""
STATUS_INTERVAL_S = 0.5
"""Seconds between two status messages in the log."""
PEER_POLL_S = 0.02
"""Seconds that a wait for a peer's track sleeps before it looks at what the TMC sent; ten times as long in a long wait,
which costs less than 1 % of a core."""


class Left(Exception):  # noqa: N818  not an error: the flight is over
    """The TMC sent this UAV home, or away; carries the exit code and the sentence for it."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


def another_mission(path: Path, run: str) -> bool:
    """Whether a log that is there, and would be gone on with, is of another mission than `run`."""
    there = [log for log in (path.with_name(path.name + ACTIVE), path) if log.is_file() and log.stat().st_size]
    return bool(there) and Log(there[0]).metadata().get("run", run) != run


class Service:
    """UAV `uav` of the mission that the TMC at `endpoint` runs; logs to `out`."""

    def __init__(self, uav: int, endpoint: str, out: Path) -> None:
        self.uav, self.endpoint, self.out = uav, endpoint, out
        self.incarnation = int.from_bytes(os.urandom(7), "big")
        self.context: zmq.Context[Any] = zmq.Context()
        self.sock = sockets.dealer(self.context, endpoint, f"uav-{uav:03d}")
        self.log: LogWriter | None = None
        self.reminder = process.Reminder()
        self.waited, self._peer = 0.0, -1
        self.table: TableTracks | None = None
        self.lead: Lead | None = None
        self.hasher: ObservationHasher | None = None
        self.ack_log: AckLog | None = None
        self._said, self._silence = time.monotonic(), RETRY_BACKOFF_S[0]
        self._reported, self._status_due, self._asked, self._ask_at = (self._said, 0), 0.0, 0.0, 0.0

    def fly(self, stop: Callable[[], bool]) -> NoReturn:
        """The main loop; raises Left when the TMC, or a signal, ends it."""
        self.pilot, self.radio = self._join(stop)
        pilot, naps = self.pilot, 0
        while not stop():
            self._remind()
            try:
                record = pilot.advance()
            except Waiting as waiting:
                self._stopped("distance", waiting.peer)
                self._wait_for_peer(waiting, naps)
                naps += 1
                continue
            naps, self._peer = 0, -1
            self._stopped("end" if pilot.t == pilot.config.training.ticks else "exchange")
            if record is not None:
                self.say(record)
                self._report(record)
            self._listen(0 if pilot.under_way else 0.1)
        raise Left(process.STOPPED, "stopped by a signal")

    def _join(self, stop: Callable[[], bool]) -> tuple[Pilot, RadioTracks | None]:
        """Say hello until the TMC answers, and build the pilot of the mission that it names."""
        hello = m.Hello("uav", self.uav, self.incarnation)
        while not stop():
            if self.reminder.due():
                process.note(f"UAV {self.uav} waits for a TMC at {sockets.waiting(self.endpoint)}")
            self.say(hello)
            if self.sock.poll(int(RETRY_BACKOFF_S[0] * 1000)):
                message = self._receive()
                if isinstance(message, m.Welcome):
                    return self._make_pilot(message)
                if isinstance(message, m.End):
                    raise Left(process.DONE, message.reason)
                if isinstance(message, m.Error):
                    self._on_error(message)
        raise Left(process.STOPPED, "stopped before the TMC answered")

    def _make_pilot(self, welcome: m.Welcome) -> tuple[Pilot, RadioTracks | None]:
        config = build(json.loads(welcome.config))
        world = world_of_run(config, self.out)
        if world.map.fingerprint != welcome.map:
            raise Left(process.USAGE, f"the map '{config.world.map}' here is not the one that the TMC flies: copy it")
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / f"uav-{self.uav:03d}.mcap"
        if another_mission(path, welcome.run):
            raise Left(process.USAGE, f"{path} is the log of another mission: choose another --out")
        self.log = LogWriter(path, f"uav-{self.uav:03d}", config.journal, {"run": welcome.run}, resume=True)
        observer, team = ObservationBuilder(world), config.team.size
        tracks: Tracks
        radio = None
        if welcome.tracks:
            tracks = self.table = TableTracks(open_table(Path(welcome.tracks), team, config.training.ticks), self.uav)
        else:
            tracks = radio = RadioTracks(self.uav, team, world.grid, observer.sensing, self._beacon)
        if stalls(config, self.uav):
            tracks = StallingTracks(tracks, config, self.uav)
        self.lead = Lead() if config.trial.stall else None
        self.hasher = hasher = ObservationHasher(observer) if config.trial.observation_hash else None
        self.ack_log = AckLog(self.out, self.uav) if config.trial.ack_log else None

        def controller(model: bytes) -> Controller:
            from actors.policy import PolicyController  # noqa: PLC0415  planners start without ONNX Runtime

            network = PolicyController(model, config, observer)
            return hasher.watch(network) if hasher else network

        who = config.team.controller
        planner: Controller | None = PlannerController(world, who) if who.startswith(PREFIX) else None
        planner = hasher.watch(planner) if hasher and planner else planner
        return Pilot(world, self.uav, self.incarnation, tracks, observer, controller, planner, time.time_ns), radio

    def _remind(self) -> None:
        """Ask the TMC for what the mission waits, where this UAV has not moved for some seconds, and tell."""
        if self.reminder.due(self.pilot.steps):
            if self.reminder.asked:
                process.note(f"UAV {self.uav} waits for an answer of the TMC at {self.endpoint}")
            self.reminder.asked = True
            self.say(m.StatusRequest())

    def _on_status(self, status: m.Status) -> None:
        if self.reminder.asked and status.waiting:
            process.note(f"UAV {self.uav} waits; the mission waits for {status.waiting}")
        self.reminder.asked = False

    # The radio.

    def say(self, message: m.Message) -> None:
        """Put a message on the air; it may be lost."""
        self._said = time.monotonic()
        sockets.send(self.sock, message)

    def leave(self, reason: str) -> None:
        """Tell the TMC why this process ends."""
        self.say(m.Bye("uav", self.uav, plain(reason)))

    def _beacon(self, beacon: m.Beacon) -> None:
        sockets.send(self.sock, beacon)

    def _receive(self) -> m.Message | None:
        try:
            return sockets.receive_message(self.sock)
        except CodecError as error:
            self._note("WARNING", f"dropped a frame: {error}")
            return None

    def _listen(self, patience: float) -> None:
        """Take what has come in; wait up to `patience` seconds for it, and speak again after too long a silence."""
        quiet = not self.sock.poll(int(patience * 1000))
        # The beacons of others are no answer: who flies, or waits for a peer, is heard all the same.
        if (quiet or self.pilot.under_way) and time.monotonic() - self._said > self._silence:
            self._silence = min(2 * self._silence, RETRY_BACKOFF_S[1])
            self._repeat()
        if quiet:
            return
        self._silence = RETRY_BACKOFF_S[0]
        while (message := self._receive()) is not None:
            answer = self._obey(message)
            if answer is not None:
                self.say(answer)

    def _repeat(self) -> None:
        """Silence: what was sent may be lost, and with it the TMC's memory of this process."""
        pilot = self.pilot
        if pilot.phase is Phase.MAP and pilot.pending is not None:
            self.say(pilot.pending)
        elif pilot.phase is Phase.POLICY:
            self.say(m.PolicyRequest(pilot.wanted))
        elif pilot.under_way:
            self.say(m.Alive(self.uav, self.incarnation, pilot.t, self._peer, pilot.sequence))
        else:
            self.say(m.Hello("uav", self.uav, self.incarnation))

    def _obey(self, message: m.Message | None) -> m.Message | None:
        """Act on a message of the TMC or a peer; returns what to say to it."""
        if isinstance(message, m.Begin):
            return self.pilot.begin(message)
        if isinstance(message, m.Map):
            self._acknowledged(message.acknowledged)
            return self.pilot.on_map(message)
        if isinstance(message, m.Policy):
            self.pilot.on_policy(message)
        elif isinstance(message, m.Lost):
            self.pilot.on_lost(message)
        elif isinstance(message, m.Beacon) and self.radio is not None:
            self.radio.hear(message)
        elif isinstance(message, m.Welcome):
            self._say_again(message.sequence)
        elif isinstance(message, m.End):
            self._acknowledged(message.acknowledged)
            raise Left(process.DONE, message.reason)
        elif isinstance(message, m.Status):
            self._on_status(message)
        elif isinstance(message, m.Error):
            self._on_error(message)
        return None

    def _acknowledged(self, sequence: int) -> None:
        """The TMC has all records below this one for good."""
        for record in self.pilot.acknowledge(sequence):
            if self.ack_log is not None:
                self.ack_log.append(record)

    def _say_again(self, sequence: int) -> None:
        """A TMC that was started again asks for what it has not, from record `sequence` on."""
        try:
            records = self.pilot.records_from(sequence)
        except LostRecordsError as lost:
            raise Left(process.FAILED, f"{lost}: its process must start anew") from None
        for record in records:
            self.say(record)

    def _on_error(self, error: m.Error) -> None:
        self._note("ERROR", f"the TMC says: {error.text}")
        if error.code == "fenced" and error.incarnation == self.incarnation:
            raise Left(process.FENCED, error.text)
        if error.code == "state" and time.monotonic() - self._asked > RETRY_BACKOFF_S[0]:
            self._asked = time.monotonic()  # a TMC that was started again knows less than it did
            self.say(m.Hello("uav", self.uav, self.incarnation))
        if error.code in {"refused", "version"}:
            raise Left(process.USAGE, f"the TMC refused: {error.text}")

    def _wait_for_peer(self, waiting: Waiting, tries: int) -> None:
        """Wait for the cell of a peer: until its row of the table shows it, or its beacon wakes the socket."""
        start, self._peer = time.monotonic(), waiting.peer
        if self.table is not None:
            self.table.wait(waiting.peer, waiting.tick, PEER_POLL_S * min(1 + tries, 10))
        elif self.radio is not None:
            self._ask_at = self._ask_at if tries else start + ASK_INTERVAL_S
            self.sock.poll(max(0, math.ceil(1000 * (self._ask_at - start))))
            if time.monotonic() >= self._ask_at:  # whatever else came in
                self._ask_at += ASK_INTERVAL_S
                self.radio.ask(waiting.peer)
        waited = time.monotonic() - start
        if (
            self.table is None or waited >= PEER_POLL_S or tries >= 10
        ):  # a row may show another episode at once, for ever
            self._listen(0)
        self.waited += waited

    def _stopped(self, bound: str, peer: int = -1) -> None:
        """In a trial: the UAV can fly no further for now, unless it is under way or has nothing to fly."""
        pilot = self.pilot
        if self.lead is None or pilot.phase is Phase.IDLE or (peer < 0 and pilot.under_way):
            return
        lead = pilot.airspace.lead(pilot.t)
        if peer < 0 or pilot.t - pilot.airspace.tracks.newest(peer)[0] == lead:  # not one that is ahead of the slowest
            self.lead.note(lead, pilot.t, bound)

    # The log.

    def _note(self, level: str, text: str) -> None:
        if self.log is not None:
            self.log.log(level.lower(), text)

    def _report(self, record: m.Record) -> None:
        """Where the UAV is, how fast it flies and how long it waited: for whoever looks at the log."""
        if self.log is not None and self.hasher is not None:
            self.log.write(uav_topic(self.uav, "observation_hash"), self.hasher.hashes_for(record))
        pilot, (then, steps), now = self.pilot, self._reported, time.monotonic()
        due = now >= self._status_due or (self.lead is not None and record.tick == pilot.config.training.ticks)
        if self.log is None or not due:
            return
        rate = (pilot.steps - steps) / (now - then)
        self._reported, self._status_due = (now, pilot.steps), now + STATUS_INTERVAL_S
        self.log.write(uav_topic(self.uav, "status"), UavStatus(
            uav=self.uav, episode=record.episode, tick=record.tick, cell=pilot.cell, waited=self.waited,
            steps_per_second=rate, explored=pilot.explored, lead=pilot.airspace.lead(pilot.t), **self._lead_so_far(),
        ))  # fmt: skip
        where = pilot.world.map.lonlat(pilot.cell)
        if where is not None:
            self.log.write(uav_topic(self.uav, "fix"), location_fix(*where, self.log.now()))

    def _lead_so_far(self) -> dict[str, Any]:
        if self.lead is None:
            return {}
        return {"lead_most": self.lead.most, "lead_tick": self.lead.tick, "lead_bound": self.lead.bound}

    def close(self) -> None:
        """Close the socket and the log."""
        self.context.destroy(linger=200)
        if self.log is not None:
            self.log.close()
