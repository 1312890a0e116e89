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
from actors.stalls import Lead, StallingTracks, can_stall
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
"""Wait (s) before an unanswered message is resent: first and longest; it doubles in between."""
ASK_INTERVAL_S = 0.2
"""Interval (s) at which a UAV that waits for a peer's beacon requests it."""
STATUS_INTERVAL_S = 0.5
"""Interval (s) of the status messages in the log."""
PEER_POLL_S = 0.02
"""Interval (s) at which a wait for a peer's track checks for messages of the TMC.

Up to ten times as long in a long wait, so that it costs less than 1 % of a core.
"""


class FlightEnded(Exception):  # noqa: N818  not an error: the flight is over
    """The TMC or a signal ended this UAV's flight; carries the exit code and the sentence for it."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


def belongs_to_another_run(path: Path, run: str) -> bool:
    """Return whether the log that would be resumed belongs to another run than `run`."""
    logs = [log for log in (path.with_name(path.name + ACTIVE), path) if log.is_file() and log.stat().st_size]
    return bool(logs) and Log(logs[0]).metadata().get("run", run) != run


class Service:
    """Runs UAV `uav` of the mission of the TMC at `endpoint`; logs to the folder `out`."""

    def __init__(self, uav: int, endpoint: str, out: Path) -> None:
        self.uav, self.endpoint, self.out = uav, endpoint, out
        self.incarnation = int.from_bytes(os.urandom(7), "big")
        self.context: zmq.Context[Any] = zmq.Context()
        self.sock = sockets.dealer(self.context, endpoint, f"uav-{uav:03d}")
        self.log: LogWriter | None = None
        self.reminder = process.Reminder()
        self.waited, self._awaited_peer = 0.0, -1
        self.table: TableTracks | None = None
        self.lead: Lead | None = None
        self.hasher: ObservationHasher | None = None
        self.ack_log: AckLog | None = None
        self._sent_at, self._retry_s = time.monotonic(), RETRY_BACKOFF_S[0]
        self._reported, self._status_due, self._hello_at, self._ask_at = (self._sent_at, 0), 0.0, 0.0, 0.0

    def fly(self, stop: Callable[[], bool]) -> NoReturn:
        """Run the main loop. Raises FlightEnded when the TMC or a signal ends the flight."""
        self.pilot, self.radio = self._join(stop)
        pilot, tries = self.pilot, 0
        while not stop():
            self._ask_what_is_waited_for()
            try:
                record = pilot.advance()
            except Waiting as waiting:
                self._note_lead("distance", waiting.peer)
                self._wait_for_peer(waiting, tries)
                tries += 1
                continue
            tries, self._awaited_peer = 0, -1
            self._note_lead("end" if pilot.t == pilot.config.training.ticks else "exchange")
            if record is not None:
                self.send(record)
                self._log_status(record)
            self._receive_all(0 if pilot.under_way else 0.1)
        raise FlightEnded(process.STOPPED, "stopped by a signal")

    def _join(self, stop: Callable[[], bool]) -> tuple[Pilot, RadioTracks | None]:
        """Send Hello until the TMC answers, and build the pilot of the mission that it names. Raises FlightEnded."""
        hello = m.Hello("uav", self.uav, self.incarnation)
        while not stop():
            if self.reminder.due():
                process.note(f"UAV {self.uav} waits for a TMC at {sockets.waiting(self.endpoint)}")
            self.send(hello)
            if self.sock.poll(int(RETRY_BACKOFF_S[0] * 1000)):
                message = self._receive()
                if isinstance(message, m.Welcome):
                    return self._make_pilot(message)
                if isinstance(message, m.End):
                    raise FlightEnded(process.DONE, message.reason)
                if isinstance(message, m.Error):
                    self._on_error(message)
        raise FlightEnded(process.STOPPED, "stopped before the TMC answered")

    def _make_pilot(self, welcome: m.Welcome) -> tuple[Pilot, RadioTracks | None]:
        config = build(json.loads(welcome.config))
        world = world_of_run(config, self.out)
        if world.map.fingerprint != welcome.map:
            raise FlightEnded(
                process.USAGE, f"the map '{config.world.map}' here is not the one that the TMC flies: copy it"
            )
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / f"uav-{self.uav:03d}.mcap"
        if belongs_to_another_run(path, welcome.run):
            raise FlightEnded(process.USAGE, f"{path} is the log of another mission: choose another --out")
        self.log = LogWriter(path, f"uav-{self.uav:03d}", config.journal, {"run": welcome.run}, resume=True)
        observer, team = ObservationBuilder(world), config.team.size
        tracks: Tracks
        radio = None
        if welcome.tracks:
            tracks = self.table = TableTracks(open_table(Path(welcome.tracks), team, config.training.ticks), self.uav)
        else:
            tracks = radio = RadioTracks(self.uav, team, world.grid, observer.sensing, self._send_beacon)
        if can_stall(config, self.uav):
            tracks = StallingTracks(tracks, config, self.uav)
        self.lead = Lead() if config.trial.stall else None
        self.hasher = hasher = ObservationHasher(observer) if config.trial.observation_hash else None
        self.ack_log = AckLog(self.out, self.uav) if config.trial.ack_log else None

        def controller(model: bytes) -> Controller:
            from actors.policy import PolicyController  # noqa: PLC0415  planners start without ONNX Runtime

            network = PolicyController(model, config, observer)
            return hasher.watch(network) if hasher else network

        name = config.team.controller
        planner: Controller | None = PlannerController(world, name) if name.startswith(PREFIX) else None
        planner = hasher.watch(planner) if hasher and planner else planner
        return Pilot(world, self.uav, self.incarnation, tracks, observer, controller, planner, time.time_ns), radio

    def _ask_what_is_waited_for(self) -> None:
        """Ask the TMC what the mission waits for, if this UAV has not moved for some seconds."""
        if self.reminder.due(self.pilot.steps):
            if self.reminder.asked:
                process.note(f"UAV {self.uav} waits for an answer of the TMC at {self.endpoint}")
            self.reminder.asked = True
            self.send(m.StatusRequest())

    def _on_status(self, status: m.Status) -> None:
        """Print what the mission waits for, if this process asked for it."""
        if self.reminder.asked and status.waiting:
            process.note(f"UAV {self.uav} waits; the mission waits for {status.waiting}")
        self.reminder.asked = False

    # The radio.

    def send(self, message: m.Message) -> None:
        """Send a message to the TMC; it may be lost."""
        self._sent_at = time.monotonic()
        sockets.send(self.sock, message)

    def leave(self, reason: str) -> None:
        """Tell the TMC why this process ends."""
        self.send(m.Bye("uav", self.uav, plain(reason)))

    def _send_beacon(self, beacon: m.Beacon) -> None:
        sockets.send(self.sock, beacon)

    def _receive(self) -> m.Message | None:
        try:
            return sockets.receive_message(self.sock)
        except CodecError as error:
            self._log_text("WARNING", f"dropped a frame: {error}")
            return None

    def _receive_all(self, patience: float) -> None:
        """Handle the messages that arrive within `patience` seconds; resend what was not answered for too long."""
        quiet = not self.sock.poll(int(patience * 1000))
        # Beacons of peers are not an answer, so a UAV that flies, or waits for a peer, also resends.
        if (quiet or self.pilot.under_way) and time.monotonic() - self._sent_at > self._retry_s:
            self._retry_s = min(2 * self._retry_s, RETRY_BACKOFF_S[1])
            self._resend()
        if quiet:
            return
        self._retry_s = RETRY_BACKOFF_S[0]
        while (message := self._receive()) is not None:
            answer = self._handle(message)
            if answer is not None:
                self.send(answer)

    def _resend(self) -> None:
        """Send again what waits for an answer: it may be lost, and a restarted TMC may not know this process."""
        pilot = self.pilot
        if pilot.phase is Phase.MAP and pilot.pending is not None:
            self.send(pilot.pending)
        elif pilot.phase is Phase.POLICY:
            self.send(m.PolicyRequest(pilot.wanted))
        elif pilot.under_way:
            self.send(m.Alive(self.uav, self.incarnation, pilot.t, self._awaited_peer, pilot.sequence))
        else:
            self.send(m.Hello("uav", self.uav, self.incarnation))

    def _handle(self, message: m.Message | None) -> m.Message | None:
        """Handle a message of the TMC or a peer; return the answer to the TMC. Raises FlightEnded."""
        if isinstance(message, m.Begin):
            return self.pilot.on_begin(message)
        if isinstance(message, m.Map):
            self._acknowledged(message.acknowledged)
            return self.pilot.on_map(message)
        if isinstance(message, m.Policy):
            self.pilot.on_policy(message)
        elif isinstance(message, m.Lost):
            self.pilot.on_lost(message)
        elif isinstance(message, m.Beacon) and self.radio is not None:
            self.radio.on_beacon(message)
        elif isinstance(message, m.Welcome):
            self._resend_records(message.sequence)
        elif isinstance(message, m.End):
            self._acknowledged(message.acknowledged)
            raise FlightEnded(process.DONE, message.reason)
        elif isinstance(message, m.Status):
            self._on_status(message)
        elif isinstance(message, m.Error):
            self._on_error(message)
        return None

    def _acknowledged(self, sequence: int) -> None:
        """Note that the TMC has durably journalled all records below `sequence`."""
        for record in self.pilot.acknowledge(sequence):
            if self.ack_log is not None:
                self.ack_log.append(record)

    def _resend_records(self, sequence: int) -> None:
        """Resend the records from `sequence` on to a restarted TMC, which lacks them. Raises FlightEnded."""
        try:
            records = self.pilot.records_from(sequence)
        except LostRecordsError as lost:
            raise FlightEnded(process.FAILED, f"{lost}: its process must be started again") from None
        for record in records:
            self.send(record)

    def _on_error(self, error: m.Error) -> None:
        """Log an error of the TMC; leave, or say Hello again, where that is the fix. Raises FlightEnded."""
        self._log_text("ERROR", f"error from the TMC: {error.text}")
        if error.code == "fenced" and error.incarnation == self.incarnation:
            raise FlightEnded(process.FENCED, error.text)
        if error.code == "state" and time.monotonic() - self._hello_at > RETRY_BACKOFF_S[0]:
            self._hello_at = time.monotonic()  # a restarted TMC does not know this process
            self.send(m.Hello("uav", self.uav, self.incarnation))
        if error.code in {"refused", "version"}:
            raise FlightEnded(process.USAGE, f"the TMC refused: {error.text}")

    def _wait_for_peer(self, waiting: Waiting, tries: int) -> None:
        """Wait for the cell of a peer, until its row of the table has it, or a message arrives.

        `tries`: waits for this cell so far; a long wait checks for messages less often.
        """
        start, self._awaited_peer = time.monotonic(), waiting.peer
        if self.table is not None:
            self.table.wait(waiting.peer, waiting.tick, PEER_POLL_S * min(1 + tries, 10))
        elif self.radio is not None:
            self._ask_at = self._ask_at if tries else start + ASK_INTERVAL_S
            self.sock.poll(max(0, math.ceil(1000 * (self._ask_at - start))))
            if time.monotonic() >= self._ask_at:  # also while other messages keep arriving
                self._ask_at += ASK_INTERVAL_S
                self.radio.request_track(waiting.peer)
        waited = time.monotonic() - start
        # A row of another episode may end each wait at once, so also listen after ten waits.
        if self.table is None or waited >= PEER_POLL_S or tries >= 10:
            self._receive_all(0)
        self.waited += waited

    def _note_lead(self, bound: str, peer: int = -1) -> None:
        """In a trial, note the lead of a UAV that must wait, and what bounds it."""
        pilot = self.pilot
        if self.lead is None or pilot.phase is Phase.IDLE or (peer < 0 and pilot.under_way):
            return
        lead = pilot.airspace.lead(pilot.t)
        if peer < 0 or pilot.t - pilot.airspace.tracks.newest(peer)[0] == lead:  # only for the slowest peer
            self.lead.update(lead, pilot.t, bound)

    # The log.

    def _log_text(self, level: str, text: str) -> None:
        if self.log is not None:
            self.log.log(level.lower(), text)

    def _log_status(self, record: m.Record) -> None:
        """Log the UAV's position, rate and waiting time every STATUS_INTERVAL_S, and the hashes of every record."""
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
            steps_per_second=rate, explored=pilot.explored, lead=pilot.airspace.lead(pilot.t), **self._lead_fields(),
        ))  # fmt: skip
        where = pilot.world.map.lonlat(pilot.cell)
        if where is not None:
            self.log.write(uav_topic(self.uav, "fix"), location_fix(*where, self.log.now()))

    def _lead_fields(self) -> dict[str, Any]:
        if self.lead is None:
            return {}
        return {"lead_most": self.lead.ticks, "lead_tick": self.lead.tick, "lead_bound": self.lead.bound}

    def close(self) -> None:
        """Close the socket and the log."""
        self.context.destroy(linger=200)
        if self.log is not None:
            self.log.close()
