"""The learner as a process: a socket, a clock and a log around the trainer, one loop with requests in flight."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq

from learner import checkpoint
from learner.batching import BatchBuilder
from learner.checkpoint import CheckpointError, Saved
from learner.trainer import UpdateMetrics, start
from tmc.kernel import files
from tmc.kernel.config import build
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.world import world_of_run
from tmc.record.disk import write_atomically
from tmc.record.overfly_pb2 import LearnerMetrics
from tmc.record.run_folder import RunFolder
from tmc.record.writer import LogWriter
from tmc.wire import capacity, process, sockets
from tmc.wire import messages as m
from tmc.wire.codec import CodecError
from tmc.wire.sockets import EndpointError

MAX_REQUESTS = 2
"""Minibatch requests in flight, so that the learner never waits for a round trip."""
HELLO_INTERVAL_S = 1.0
"""Time (s) without a minibatch after which the learner sends Hello again, because the TMC may have restarted."""
METRICS_INTERVAL_S = 0.2
"""Interval (s) of the metrics messages in the log."""


class ReplacedError(Exception):
    """A newer process is now the learner of the mission."""


class Service:
    """Runs the learner of the mission of the TMC at `endpoint`; logs, checkpoints and policies go to `out`."""

    def __init__(self, endpoint: str, out: Path) -> None:
        self.endpoint, self.out = endpoint, out
        self.incarnation = int.from_bytes(os.urandom(7), "big")
        self.context: zmq.Context[Any] = zmq.Context()
        self.sock = sockets.dealer(self.context, sockets.learner_endpoint(endpoint), "learner")
        self.log: LogWriter | None = None
        self.reminder = process.Reminder()
        self._request, self._in_flight = 0, set[int]()
        """The number of the last request for a minibatch, and the requests in flight."""
        self._hello_sent = False
        """Whether a Hello was sent since the last Welcome that was acted on."""
        self._idle = 0.0
        self._metrics_due = 0.0
        self._unlogged: tuple[UpdateMetrics, m.Minibatch] | None = None
        """The last update, until it is logged."""
        self._loss = 0.0

    def learn(self, stop: Callable[[], bool]) -> bool:
        """Run the main loop, then write the last checkpoint and policy. Returns whether the mission ended.

        Raises MISTAKES of `learner.__main__`, and ReplacedError.
        """
        folder, skipped = RunFolder(self.out).checkpoints, list[str]()
        saved = checkpoint.newest(folder, skipped.append)
        if skipped and saved is None:
            raise CheckpointError(f"no checkpoint in {folder} is intact: remove them all to begin with new weights")
        welcome = self._join(saved, stop)
        if not isinstance(welcome, m.Welcome):
            return welcome is not None
        self._prepare(welcome, saved)
        for text in skipped:
            self._log_text("warning", text)
        self._publish()
        self._request_minibatches()
        over = False
        while not over and not stop():
            self._ask_what_is_waited_for()
            for message in self._receive_within_interval():
                over |= self._handle(message)
        self._finish()
        return over

    def _join(self, saved: Saved | None, stop: Callable[[], bool]) -> m.Welcome | m.End | None:
        """Send Hello until the TMC answers; return the answer, or None when stopped before. Raises EndpointError."""
        while not stop():
            if self.reminder.due():
                process.note(
                    f"the learner waits for a TMC at {sockets.waiting(sockets.learner_endpoint(self.endpoint))}"
                )
            sockets.send(
                self.sock,
                m.Hello(
                    role="learner", uav=-1, incarnation=self.incarnation, updates=saved.meta.updates if saved else 0
                ),
            )
            if self.sock.poll(1000):
                message = self._receive()
                if isinstance(message, m.Welcome | m.End):
                    return message
                if isinstance(message, m.Error):
                    raise EndpointError(f"the TMC refused: {message.text}")
        return None

    def _prepare(self, welcome: m.Welcome, saved: Saved | None) -> None:
        """Build the trainer and the log of the mission; load the checkpoint. Raises EndpointError, CheckpointError."""
        config = build(json.loads(welcome.config))
        world = world_of_run(config, self.out)
        capacity.check(world, learning=True)
        if world.map.fingerprint != welcome.map:
            raise EndpointError(f"the map '{config.world.map}' here is not the one that the TMC flies: copy it")
        self._claim_folder(welcome.run)
        self._run = welcome.run
        self.config = config
        self.trainer, self.builder = start(config, world.grid), BatchBuilder(ObservationBuilder(world))
        self.out.mkdir(parents=True, exist_ok=True)
        self.log = LogWriter(self.out / "learner.mcap", "learner", config.journal, {"run": welcome.run}, resume=True)
        if saved is not None:
            checkpoint.load(saved, self.trainer)
            self.log.log("info", f"resumes from {saved.name}")
        self.trainer.version = max(self.trainer.version, welcome.policy)
        self._start = self._logged_at = time.monotonic()
        self._logged_updates = self.trainer.updates

    def _claim_folder(self, run: str) -> None:
        """Mark the folder as this run's. Raises EndpointError for a folder with the checkpoints of another run."""
        mark = self.out / "learner.run"
        if mark.exists() and not run.startswith(files.read_text(mark).strip()):  # a power cut may leave half of it
            raise EndpointError(f"{self.out} holds what was learned in another mission: choose another --out")
        self.out.mkdir(parents=True, exist_ok=True)
        mark.write_text(run + "\n", "utf-8")

    def _receive_within_interval(self) -> list[m.Message]:
        """Return the next message, if one arrives within HELLO_INTERVAL_S; the wait counts as idle time."""
        since = time.monotonic()
        if not self.sock.poll(int(HELLO_INTERVAL_S * 1000)):
            sockets.send(
                self.sock, m.Hello(role="learner", uav=-1, incarnation=self.incarnation, updates=self.trainer.updates)
            )
            self._hello_sent = True
        self._idle += time.monotonic() - since
        message = self._receive()
        return [] if message is None else [message]

    def _ask_what_is_waited_for(self) -> None:
        """Ask the TMC what the mission waits for, if there was nothing to learn for some seconds."""
        if self.reminder.due(self.trainer.updates):
            if self.reminder.asked:
                process.note(f"the learner waits for an answer of the TMC at {self.endpoint}")
            self.reminder.asked = True
            sockets.send(self.sock, m.StatusRequest())

    def _on_status(self, status: m.Status) -> None:
        """Print what the mission waits for, if this process asked for it."""
        if self.reminder.asked and status.waiting:
            process.note(f"the learner waits; the mission waits for {status.waiting}")
        self.reminder.asked = False

    def _receive(self) -> m.Message | None:
        try:
            return sockets.receive_message(self.sock)
        except CodecError as error:
            self._log_text("warning", f"dropped a frame: {error}")
            return None

    def _log_text(self, level: str, text: str) -> None:
        if self.log is not None:
            self.log.log(level, text)

    def _handle(self, message: m.Message) -> bool:
        """Handle a message of the TMC; return whether the mission is over. Raises ReplacedError, EndpointError."""
        if isinstance(message, m.Minibatch):
            self._update(message)
            self._in_flight.discard(message.request)
            self._request_minibatches()  # now, while the threads of the update no longer compete with the TMC
        elif isinstance(message, m.Welcome) and message.run != self._run:
            raise EndpointError("another mission runs here now: start a learner for it with another --out")
        elif isinstance(message, m.Welcome):  # a restarted TMC, which lost the requests and perhaps its numbers
            self.trainer.forget()
            self.trainer.version = max(self.trainer.version, message.policy)
            if self._hello_sent:  # once for all Hellos that a restarted TMC answers
                self._hello_sent = False
                self._in_flight.clear()
                self._publish()
                self._request_minibatches()
        elif isinstance(message, m.Status):
            self._on_status(message)
        elif isinstance(message, m.Error):
            self._log_text("error", f"error from the TMC: {message.text}")
            if message.code == "fenced" and message.incarnation == self.incarnation:
                raise ReplacedError(message.text)
        return isinstance(message, m.End)

    def _request_minibatches(self) -> None:
        """Request minibatches until MAX_REQUESTS are in flight."""
        while len(self._in_flight) < MAX_REQUESTS:
            self._request += 1
            self._in_flight.add(self._request)
            index, errors = self.trainer.take_td_errors()
            sockets.send(
                self.sock,
                m.SampleRequest(request=self._request, index=index, errors=errors, incarnation=self.incarnation),
            )

    def _update(self, minibatch: m.Minibatch) -> None:
        """Make one update; publish a policy, write a checkpoint and log metrics when due. Raises TrainingError."""
        metrics = self.trainer.update(self.builder.build(minibatch))
        self._loss = metrics.loss
        if metrics.updates % self.config.training.publish_every == 0:
            self._publish()
        if metrics.updates % self.config.training.checkpoint_every == 0:
            checkpoint.save(RunFolder(self.out).checkpoints, self.trainer)
        self._note_metrics(metrics, minibatch)

    def _publish(self) -> bytes:
        """Publish the current policy to the TMC; return its file."""
        version, model = self.trainer.policy()
        push = m.PolicyPush(
            version=version,
            updates=self.trainer.updates,
            loss=self._loss,
            model=model,
            sent=time.time_ns(),
            incarnation=self.incarnation,
        )
        sockets.send(self.sock, push)
        return model

    def _note_metrics(self, metrics: UpdateMetrics, minibatch: m.Minibatch) -> None:
        now = time.monotonic()
        self._unlogged = (metrics, minibatch)
        if now >= self._metrics_due:
            self._log_metrics(now)

    def _log_metrics(self, now: float) -> None:
        """Log the metrics of the last update."""
        if self._unlogged is None or self.log is None:
            return
        (metrics, minibatch), self._unlogged = self._unlogged, None
        span = max(now - self._logged_at, 1e-9)
        self.log.write("/learner/metrics", LearnerMetrics(
            updates=metrics.updates, episode=minibatch.episodes, steps=minibatch.ticks * self.config.team.size,
            loss=metrics.loss, q_mean=metrics.q_mean, target_mean=metrics.target_mean, td_abs=metrics.td_abs,
            grad_norm=metrics.grad_norm, updates_per_second=(metrics.updates - self._logged_updates) / span,
            idle_share=min(self._idle / span, 1.0), wall=now - self._start,
        ))  # fmt: skip
        self._logged_at, self._logged_updates, self._idle = now, metrics.updates, 0.0
        self._metrics_due = now + METRICS_INTERVAL_S

    def _finish(self) -> None:
        """Log the last metrics, write the last checkpoint, publish the last policy, and write its file."""
        self._log_metrics(time.monotonic())
        checkpoint.save(RunFolder(self.out).checkpoints, self.trainer)
        write_policy(RunFolder(self.out).final_policy, self._publish())
        sockets.send(self.sock, m.Bye(role="learner", uav=-1, reason=f"{self.trainer.updates} updates"))

    def close(self) -> None:
        """Close the socket and the log."""
        self.context.destroy(linger=500)
        if self.log is not None:
            self.log.close()


def write_policy(path: Path, model: bytes) -> None:
    """Write a policy file whole or not at all; make its folder where there is none. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, model, sync=False)
