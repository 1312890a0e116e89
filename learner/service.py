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
from tmc.record.run_folder import RunFolder
from tmc.record.schemas import LearnerMetrics
from tmc.record.writer import LogWriter
from tmc.wire import capacity, process, sockets
from tmc.wire import messages as m
from tmc.wire.codec import CodecError
from tmc.wire.sockets import EndpointError

WINDOW = 2
"""Minibatch requests in flight, so that the learner never waits for the way there and back."""
HELLO_INTERVAL_S = 1.0
"""Seconds without a minibatch after which the learner says hello again: the TMC may have been started anew."""
METRICS_INTERVAL_S = 0.2
"""Seconds between two metrics messages in the log."""


class ReplacedError(Exception):
    """A newer process is the learner of the mission now."""


class Service:
    """The learner of the mission that the TMC at `endpoint` runs; logs, checkpoints and policies go to `out`."""

    def __init__(self, endpoint: str, out: Path) -> None:
        self.endpoint, self.out = endpoint, out
        self.incarnation = int.from_bytes(os.urandom(7), "big")
        self.context: zmq.Context[Any] = zmq.Context()
        self.sock = sockets.dealer(self.context, sockets.learner_endpoint(endpoint), "learner")
        self.log: LogWriter | None = None
        self.reminder = process.Reminder()
        self._request, self._flying = 0, set[int]()
        """The number of the last request for a minibatch, and the requests in flight."""
        self._hailed = False
        """Whether a Hello went out since the last Welcome that was acted on."""
        self._idle = 0.0
        self._metrics_due = 0.0
        self._untold: tuple[UpdateMetrics, m.Minibatch] | None = None
        """The last update, while the log has not got it."""
        self._loss = 0.0

    def learn(self, stop: Callable[[], bool]) -> bool:
        """The main loop; True when the mission came to its end, False when stopped. Leaves checkpoint and policy."""
        folder, skipped = RunFolder(self.out).checkpoints, list[str]()
        saved = checkpoint.newest(folder, skipped.append)
        if skipped and saved is None:
            raise CheckpointError(f"no checkpoint in {folder} is intact: remove them all to begin with new weights")
        welcome = self._join(saved, stop)
        if not isinstance(welcome, m.Welcome):
            return welcome is not None
        self._prepare(welcome, saved)
        for text in skipped:
            self._say("warning", text)
        self._push()
        self._ask()
        over = False
        while not over and not stop():
            self._remind()
            for message in self._listen():
                over |= self._obey(message)
        self._finish()
        return over

    def _join(self, saved: Saved | None, stop: Callable[[], bool]) -> m.Welcome | m.End | None:
        """Say hello until the TMC answers; None when stopped before."""
        while not stop():
            if self.reminder.due():
                process.note(
                    f"the learner waits for a TMC at {sockets.waiting(sockets.learner_endpoint(self.endpoint))}"
                )
            sockets.send(self.sock, m.Hello("learner", -1, self.incarnation, saved.meta.updates if saved else 0))
            if self.sock.poll(1000):
                message = self._receive()
                if isinstance(message, m.Welcome | m.End):
                    return message
                if isinstance(message, m.Error):
                    raise EndpointError(f"the TMC refused: {message.text}")
        return None

    def _prepare(self, welcome: m.Welcome, saved: Saved | None) -> None:
        config = build(json.loads(welcome.config))
        world = world_of_run(config, self.out)
        capacity.check(world, learning=True)
        if world.map.fingerprint != welcome.map:
            raise EndpointError(f"the map '{config.world.map}' here is not the one that the TMC flies: copy it")
        self._own(welcome.run)
        self._run = welcome.run
        self.config = config
        self.trainer, self.builder = start(config, world.grid), BatchBuilder(ObservationBuilder(world))
        self.out.mkdir(parents=True, exist_ok=True)
        self.log = LogWriter(self.out / "learner.mcap", "learner", config.journal, {"run": welcome.run}, resume=True)
        if saved is not None:
            checkpoint.load(saved, self.trainer)
            self.log.log("info", f"goes on from {saved.name}")
        self.trainer.version = max(self.trainer.version, welcome.policy)
        self._start = self._told = time.monotonic()
        self._told_updates = self.trainer.updates

    def _own(self, run: str) -> None:
        """Refuse a folder with the checkpoints of another mission: the learner would go on from them."""
        mark = self.out / "learner.run"
        if mark.exists() and not run.startswith(files.read_text(mark).strip()):  # a power cut may leave half of it
            raise EndpointError(f"{self.out} holds what was learned in another mission: choose another --out")
        self.out.mkdir(parents=True, exist_ok=True)
        mark.write_text(run + "\n", "utf-8")

    def _listen(self) -> list[m.Message]:
        """What has come in; the time spent waiting for it is the learner's idle time."""
        since = time.monotonic()
        if not self.sock.poll(int(HELLO_INTERVAL_S * 1000)):
            sockets.send(self.sock, m.Hello("learner", -1, self.incarnation, self.trainer.updates))
            self._hailed = True
        self._idle += time.monotonic() - since
        message = self._receive()
        return [] if message is None else [message]

    def _remind(self) -> None:
        """Ask the TMC for what the mission waits, where there was nothing to learn for some seconds, and tell."""
        if self.reminder.due(self.trainer.updates):
            if self.reminder.asked:
                process.note(f"the learner waits for an answer of the TMC at {self.endpoint}")
            self.reminder.asked = True
            sockets.send(self.sock, m.StatusRequest())

    def _on_status(self, status: m.Status) -> None:
        if self.reminder.asked and status.waiting:
            process.note(f"the learner waits; the mission waits for {status.waiting}")
        self.reminder.asked = False

    def _receive(self) -> m.Message | None:
        try:
            return sockets.receive_message(self.sock)
        except CodecError as error:
            self._say("warning", f"dropped a frame: {error}")
            return None

    def _say(self, level: str, text: str) -> None:
        if self.log is not None:
            self.log.log(level, text)

    def _obey(self, message: m.Message) -> bool:
        """Act on a message of the TMC; True when the mission is over. Raises ReplacedError."""
        if isinstance(message, m.Minibatch):
            self._update(message)
            self._flying.discard(message.request)
            self._ask()  # now: the TMC is at work for it while the other threads have nothing to do
        elif isinstance(message, m.Welcome) and message.run != self._run:
            raise EndpointError("another mission runs here now: start a learner for it with another --out")
        elif isinstance(message, m.Welcome):  # a TMC that has lost our requests, and perhaps its numbers
            self.trainer.forget()
            self.trainer.version = max(self.trainer.version, message.policy)
            if self._hailed:  # one answer is enough for all hellos that a TMC found when it was back
                self._hailed = False
                self._flying.clear()
                self._push()
                self._ask()
        elif isinstance(message, m.Status):
            self._on_status(message)
        elif isinstance(message, m.Error):
            self._say("error", f"the TMC says: {message.text}")
            if message.code == "fenced" and message.incarnation == self.incarnation:
                raise ReplacedError(message.text)
        return isinstance(message, m.End)

    def _ask(self) -> None:
        """Ask for minibatches until there are WINDOW requests in flight."""
        while len(self._flying) < WINDOW:
            self._request += 1
            self._flying.add(self._request)
            sockets.send(self.sock, m.SampleRequest(self._request, *self.trainer.take_td_errors(), self.incarnation))

    def _update(self, minibatch: m.Minibatch) -> None:
        metrics = self.trainer.update(self.builder.build(minibatch))
        self._loss = metrics.loss
        if metrics.updates % self.config.training.publish_every == 0:
            self._push()
        if metrics.updates % self.config.training.checkpoint_every == 0:
            checkpoint.save(RunFolder(self.out).checkpoints, self.trainer)
        self._report(metrics, minibatch)

    def _push(self) -> bytes:
        version, model = self.trainer.policy()
        push = m.PolicyPush(version, self.trainer.updates, self._loss, model, time.time_ns(), self.incarnation)
        sockets.send(self.sock, push)
        return model

    def _report(self, metrics: UpdateMetrics, minibatch: m.Minibatch) -> None:
        now = time.monotonic()
        self._untold = (metrics, minibatch)
        if now >= self._metrics_due:
            self._tell(now)

    def _tell(self, now: float) -> None:
        """What the last update did, for the log."""
        if self._untold is None or self.log is None:
            return
        (metrics, minibatch), self._untold = self._untold, None
        span = max(now - self._told, 1e-9)
        self.log.write("/learner/metrics", LearnerMetrics(
            updates=metrics.updates, episode=minibatch.episodes, steps=minibatch.ticks * self.config.team.size,
            loss=metrics.loss, q_mean=metrics.q_mean, target_mean=metrics.target_mean, td_abs=metrics.td_abs,
            grad_norm=metrics.grad_norm, updates_per_second=(metrics.updates - self._told_updates) / span,
            idle_share=min(self._idle / span, 1.0), wall=now - self._start,
        ))  # fmt: skip
        self._told, self._told_updates, self._idle = now, metrics.updates, 0.0
        self._metrics_due = now + METRICS_INTERVAL_S

    def _finish(self) -> None:
        """The last metrics, the last checkpoint, the last policy, and its file."""
        self._tell(time.monotonic())
        checkpoint.save(RunFolder(self.out).checkpoints, self.trainer)
        write_policy(RunFolder(self.out).final_policy, self._push())
        sockets.send(self.sock, m.Bye("learner", -1, f"{self.trainer.updates} updates"))

    def close(self) -> None:
        """Close the socket and the log."""
        self.context.destroy(linger=500)
        if self.log is not None:
            self.log.close()


def write_policy(path: Path, model: bytes) -> None:
    """Write a policy file whole or not at all; make its folder where there is none. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, model, sync=False)
