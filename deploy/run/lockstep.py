"""Runs a mission in one process: the station, the pilots and, if there is one, the trainer take turns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from actors.fleet import Fleet
from actors.observation_hash import ObservationHasher
from actors.pilot import Pilot
from actors.planners import PREFIX, Controller, PlannerController
from actors.tracks import TableTracks, TrackTable
from deploy.run.progress import Progress
from tmc.center.journal import Journal
from tmc.center.roster import LEARNER, Outbox, uav_name
from tmc.center.station import Station
from tmc.kernel.config import ConfigError
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.world import World
from tmc.record.channels import uav_topic
from tmc.record.overfly_pb2 import ObservationHashes
from tmc.record.run_folder import RunFolder
from tmc.record.writer import LogWriter
from tmc.wire import messages as m

if TYPE_CHECKING:
    from learner.trainer import Trainer


RUN = "lockstep"
"""The run's name in the log of a mission in one process."""
KeepHashes = Callable[[int, ObservationHashes], None]
"""Takes (uav, overfly.ObservationHashes of the moves of a record)."""


class LockStep:
    """A mission without sockets. `keep` gets every outbox of the station before its messages are delivered.

    `keep_hashes` gets the hashes of what the UAVs decide by; None outside of trials.
    """

    def __init__(
        self,
        world: World,
        policy: bytes | None,
        keep: Callable[[Outbox], None],
        trainer: Trainer | None = None,
        keep_hashes: KeepHashes | None = None,
    ) -> None:
        config = world.config
        self.world, self.keep, self.trainer, self.keep_hashes = world, keep, trainer, keep_hashes
        self.station = Station(world, RUN, learning=trainer is not None, policy=policy)
        observer = self.station.observer
        table = TrackTable(config.team.size, config.training.ticks)
        planner = (
            PlannerController(world, config.team.controller) if config.team.controller.startswith(PREFIX) else None
        )
        controller = _controller_maker(world, observer)
        self._hashers = [ObservationHasher(observer) for _ in range(config.team.size)]

        def pilot(i: int) -> Pilot:
            tracks, watch = TableTracks(table, i), self._hashers[i].watch
            if keep_hashes is None:
                return Pilot(world, i, 1, tracks, observer, controller, planner)
            watched = watch(planner) if planner else None
            return Pilot(world, i, 1, tracks, observer, lambda model: watch(controller(model)), watched)

        pilots = [pilot(i) for i in range(config.team.size)]
        self.fleet = Fleet(pilots, self._exchange)
        self._minibatches: list[m.Minibatch] = []
        self._loss, self.final = 0.0, b""
        """The loss of the last update, and at the end the learned policy file."""
        if trainer is not None:
            from learner.batching import BatchBuilder  # noqa: PLC0415  torch only where there is a learner

            self._builder = BatchBuilder(observer)

    def _exchange(self, uav: int, message: m.Message) -> list[tuple[int, m.Message]]:
        if self.keep_hashes is not None and isinstance(message, m.Record):
            self.keep_hashes(uav, self._hashers[uav].hashes_for(message))
        self.station.handle(uav_name(uav), message, 0.0)
        return self._collect()

    def _collect(self) -> list[tuple[int, m.Message]]:
        outbox = self.station.out.take()
        self.keep(outbox)
        self.station.committed()  # in one process no message waits for the disk
        self._minibatches += [x for to, x in outbox.sends if to == LEARNER and isinstance(x, m.Minibatch)]
        return [(int(to.removeprefix("uav-")), x) for to, x in outbox.sends if to.startswith("uav-")]

    def _send_as_learner(self, message: m.Message) -> None:
        """Send a message of the learner to the station, and deliver the station's messages to the UAVs."""
        self.station.handle(LEARNER, message, 0.0)
        for uav, reply in self._collect():
            self.fleet.deliver(uav, reply)

    def run(self, show: Callable[[m.Status], None] | None = None) -> None:
        """Fly all episodes. `show` gets the status after every step. Raises FlightError, TrainingError."""
        if self.trainer is not None:
            self._send_as_learner(m.Hello(role="learner", uav=-1, incarnation=1))
            self._publish()
            self._send_as_learner(m.SampleRequest(request=0))
        for pilot in self.fleet.pilots:
            for uav, reply in self._exchange(pilot.uav, m.Hello(role="uav", uav=pilot.uav, incarnation=1)):
                self.fleet.deliver(uav, reply)
        while self.fleet.step() | self._learn():
            if show is not None:
                show(self.station.status())
        if self.trainer is not None:
            self.final = self._publish(self._loss)  # as the learner's process does at its end

    def _learn(self) -> bool:
        """Train on every minibatch that the rate limiter allows; return whether there was one."""
        trainer, learned = self.trainer, False
        while trainer is not None and self._minibatches:
            metrics = trainer.update(self._builder.build(self._minibatches.pop(0)))
            learned, self._loss = True, metrics.loss
            if metrics.updates % self.world.config.training.publish_every == 0:
                self._publish(metrics.loss)
            index, errors = trainer.take_td_errors()
            self._send_as_learner(m.SampleRequest(request=metrics.updates, index=index, errors=errors))
        return learned

    def _publish(self, loss: float = 0.0) -> bytes:
        assert self.trainer is not None
        version, model = self.trainer.policy()
        self._send_as_learner(m.PolicyPush(version=version, updates=self.trainer.updates, loss=loss, model=model))
        return model


def _controller_maker(world: World, observer: ObservationBuilder) -> Callable[[bytes], Controller]:
    """Return a maker of controllers that shares one session of a policy file among all UAVs; it holds no state."""
    made: dict[bytes, Controller] = {}

    def make(model: bytes) -> Controller:
        from actors.policy import PolicyController  # noqa: PLC0415  planners fly without ONNX Runtime

        if model not in made:
            made.clear()
            made[model] = PolicyController(model, world.config, observer)
        return made[model]

    return make


def run(world: World, out: Path, policy: Path | None, progress: Progress) -> None:
    """Fly a mission in this process, with the journal of a TMC's process. Raises ConfigError, FlightError."""
    config = world.config
    trainer = None
    if policy is None and config.team.controller == "policy":
        from learner.trainer import start  # noqa: PLC0415  torch only where there is a learner

        trainer = start(config, world.grid)
    journal = Journal(out, world, RUN)
    try:
        with _hash_logs(world, out) as keep_hashes:
            mission = LockStep(world, policy.read_bytes() if policy else None, journal.take, trainer, keep_hashes)
            _run(mission, progress.show)
        if trainer is not None:
            from learner.service import write_policy  # noqa: PLC0415  torch only where there is a learner

            write_policy(RunFolder(out).final_policy, mission.final)
    finally:
        journal.writer.close()


def _run(mission: LockStep, show: Callable[[m.Status], None]) -> None:
    """Fly and learn. Raises ConfigError if the training diverges."""
    if mission.trainer is None:
        mission.run(show)
        return
    from learner.batching import TrainingError  # noqa: PLC0415  torch only where there is a learner

    try:
        mission.run(show)
    except TrainingError as error:
        raise ConfigError(str(error)) from None


@contextmanager
def _hash_logs(world: World, out: Path) -> Iterator[KeepHashes | None]:
    """Yield a function that writes hashes to the logs that the UAVs would write; None outside of trials."""
    config = world.config
    if not config.trial.observation_hash:
        yield None
        return
    with ExitStack() as stack:
        names = [uav_name(i) for i in range(config.team.size)]
        facts = {"run": RUN}
        logs = [stack.enter_context(LogWriter(out / f"{n}.mcap", n, config.journal, facts)) for n in names]

        def keep_hashes(uav: int, message: ObservationHashes) -> None:
            logs[uav].write(uav_topic(uav, "observation_hash"), message)

        yield keep_hashes
