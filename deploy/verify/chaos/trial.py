"""The whole trial: missions under a schedule of faults, one after the other until it is over, and the result."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from deploy.run.mission import bound_of, check, command_line, interrupted
from deploy.verify.chaos.checker import DeliveryReport, check_delivery
from deploy.verify.chaos.mission import ChaosMission
from deploy.verify.chaos.schedule import FaultSchedule
from deploy.verify.exactness import NotesOnly, fly
from tmc.analysis.invariants.check import check as check_log
from tmc.kernel.config import Config, build
from tmc.kernel.world import World
from tmc.record import queries
from tmc.record.overfly_pb2 import State
from tmc.record.reader import Log
from tmc.record.run_folder import run_files
from tmc.wire import process

TRAIN: dict[str, Any] = {
    "team.size": 3, "trial.ack_log": True, "training.episodes": 1_000_000, "training.checkpoint_every": 200,
}  # fmt: skip
"""A training without an end, whose learner loses few updates with each kill."""
FLY: dict[str, Any] = {
    "team.size": 3, "trial.ack_log": True, "training.episodes": 4, "trial.stall": 0.003, "trial.stall_share": 1.0,
}  # fmt: skip
"""Missions that take about ten seconds without faults."""
WITHOUT_FAULTS: dict[str, Any] = {"trial.ack_log": False, "trial.ack_early": False, "trial.stall": 0.0}
"""The same mission in lock step, for comparison."""


class SilentProgress(NotesOnly):
    """Shows nothing; writes notes to the history."""

    schedule: FaultSchedule

    def work(self, what: str, share: float) -> None: ...

    def note(self, text: str) -> None:
        self.schedule.log(text)
        self.schedule.failures.append(text)


@dataclass
class TrialResult:
    """The result of a trial. `violations`: one sentence for each; none if the trial passed."""

    schedule: FaultSchedule
    missions: int = 0
    deliveries: list[DeliveryReport] = field(default_factory=list)
    facts: int = 0
    """Facts that `log check` compared."""
    violations: list[str] = field(default_factory=list)

    def total(self, count: str) -> int:
        """Return a count of DeliveryReport, summed over all missions."""
        return sum(getattr(delivery, count) for delivery in self.deliveries)


def run(config: Config, policy: bytes | None, place: Path, schedule: FaultSchedule, *, trains: bool) -> TrialResult:
    """Run one training, or mission after mission until the schedule is over; their folders are in `place`.

    Raises KeyboardInterrupt when the user stops it.
    """
    result = TrialResult(schedule)
    while schedule.next is not None and not result.violations:
        seed = config.training.seed + result.missions
        world = check(build({"training.seed": seed}, config), policy)
        result.missions += 1
        out = place / f"mission-{result.missions}"
        code = _fly_under_faults(world, policy, out, schedule, lasts=not trains)
        if code not in (process.DONE, process.FAILED):
            raise KeyboardInterrupt
        result.violations += schedule.failures
        _check(result, out)
        if not trains and code == process.DONE:
            _compare(result, world, policy, out)
    _check_totals(result, trains=trains)
    return result


def _fly_under_faults(world: World, policy: bytes | None, out: Path, schedule: FaultSchedule, *, lasts: bool) -> int:
    """Fly one mission under faults, resumed after each power cut; return its exit code."""
    out.mkdir()
    while True:
        progress = SilentProgress(world.config, world.law.cells.size, bound_of(world))
        mission = ChaosMission(world, out, command_line(), policy, progress)
        progress.schedule = mission.schedule = schedule
        mission.lasts = lasts
        code = mission.run(in_one_process=False)
        if code != process.DONE or schedule.power_lost is None:
            return code
        world, policy = interrupted(out)


def _check(result: TrialResult, out: Path) -> None:
    """Check the records and the invariants of a mission."""
    schedule = result.schedule
    result.deliveries.append(check_delivery(out, schedule.lost))
    schedule.lost.clear()
    checked = check_log(out, lambda what, _share: schedule.show_progress(f"{out.name}: {what}"))
    result.facts += sum(row.facts for row in checked.rows)
    result.violations += [
        f"log check: {row.name}: {row.violation}" for row in checked.rows if row.violation is not None
    ]


def _compare(result: TrialResult, world: World, policy: bytes | None, out: Path) -> None:
    """Compare a mission with the same in lock step: every cell, and maps and replay memory after each episode."""
    reference = out.with_name(f"{out.name}-lockstep")
    fly(check(build(WITHOUT_FAULTS, world.config), policy), policy, reference, in_one_process=True)
    if queries.digest(out) != queries.digest(reference):
        result.violations.append(f"{out.name} flew other cells than the same mission in lock step")
    states = _states(out)
    for episode, state in _states(reference).items():
        if states.get(episode) != state:
            result.violations.append(
                f"after episode {episode} of {out.name}, maps or replay memory are not as in lock step"
            )
            return


def _states(out: Path) -> dict[int, tuple[str, str, int]]:
    """Return, by episode, the digests of the maps and of the replay memory, and its number of transitions."""
    found = Log(run_files(out)["tmc"]).messages(State)
    return {m.episode: (m.map, m.replay, m.transitions) for m in found}


def _check_totals(result: TrialResult, *, trains: bool) -> None:
    """Check the totals of all missions; put their violations first."""
    schedule, lost, doubled = result.schedule, result.total("lost"), result.total("doubled")
    crash = next(iter(schedule.crashes), "")
    kills, recovered = sum(schedule.kills.values()), sum(schedule.recovered.values())
    sentences = {
        f"{lost:,} records were acknowledged and are lost": lost,
        f"{doubled:,} records were applied twice": doubled,
        f"{kills - recovered} of {kills} killed processes did not recover": kills - recovered,
        f"{len(schedule.crashes)} processes failed without a fault, first: {crash}": schedule.crashes,
        "the training did not resume after the last kill": trains and not schedule.resumed,
    }
    result.violations = [sentence for sentence, violated in sentences.items() if violated] + result.violations
