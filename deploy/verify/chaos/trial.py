"""The whole trial: missions under a schedule, one after the other until it is over, and the result."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from deploy.run.mission import bound_of, check, command_line, interrupted
from deploy.verify.chaos.checker import DeliveryReport, check_delivery
from deploy.verify.chaos.mission import Disturbed
from deploy.verify.chaos.schedule import FaultSchedule
from deploy.verify.exactness import Quiet, fly
from tmc.analysis.invariants.check import check as check_log
from tmc.kernel.config import Config, build
from tmc.kernel.world import World
from tmc.record import queries
from tmc.record.reader import read
from tmc.record.run_folder import run_files
from tmc.wire import process

TRAIN: dict[str, Any] = {
    "team.size": 3, "trial.ack_log": True, "training.episodes": 1_000_000, "training.checkpoint_every": 200,
}  # fmt: skip
"""A training that does not end by itself, whose learner loses little with each kill."""
FLY: dict[str, Any] = {
    "team.size": 3, "trial.ack_log": True, "training.episodes": 4, "trial.stall": 0.003, "trial.stall_share": 1.0,
}  # fmt: skip
"""Missions that take some ten seconds undisturbed."""
UNDISTURBED: dict[str, Any] = {"trial.ack_log": False, "trial.ack_early": False, "trial.stall": 0.0}
"""The same mission in lock step, for comparison."""


class SilentProgress(Quiet):
    """Shows nothing; notes go to the diary."""

    schedule: FaultSchedule

    def work(self, what: str, share: float) -> None: ...

    def note(self, text: str) -> None:
        self.schedule.write(text)
        self.schedule.failures.append(text)


@dataclass
class TrialResult:
    """What came of the trial; `faults`: sentences, none when all is well."""

    schedule: FaultSchedule
    missions: int = 0
    exact: list[DeliveryReport] = field(default_factory=list)
    facts: int = 0
    """Facts that `log check` compared."""
    faults: list[str] = field(default_factory=list)

    def sum(self, what: str) -> int:
        """Of all missions, one of the counts of DeliveryReport."""
        return sum(getattr(exact, what) for exact in self.exact)


def run(config: Config, policy: bytes | None, place: Path, schedule: FaultSchedule, *, trains: bool) -> TrialResult:
    """One training, or mission after mission until the schedule is over; their folders are in `place`.

    Raises KeyboardInterrupt when the user stops it.
    """
    result = TrialResult(schedule)
    while schedule.next is not None and not result.faults:
        seed = config.training.seed + result.missions
        world = check(build({"training.seed": seed}, config), policy)
        result.missions += 1
        out = place / f"mission-{result.missions}"
        code = _disturb(world, policy, out, schedule, lasts=not trains)
        if code not in (process.DONE, process.FAILED):
            raise KeyboardInterrupt
        result.faults += schedule.failures
        _check(result, out)
        if not trains and code == process.DONE:
            _compare(result, world, policy, out)
    _sum_up(result, trains=trains)
    return result


def _disturb(world: World, policy: bytes | None, out: Path, schedule: FaultSchedule, *, lasts: bool) -> int:
    """One mission, taken up again after each power cut; returns its exit code."""
    out.mkdir()
    while True:
        progress = SilentProgress(world.config, world.law.cells.size, bound_of(world))
        mission = Disturbed(world, out, command_line(), policy, progress)
        progress.schedule = mission.schedule = schedule
        mission.lasts = lasts
        code = mission.run(in_one_process=False)
        if code != process.DONE or schedule.power_lost is None:
            return code
        world, policy = interrupted(out)


def _check(result: TrialResult, out: Path) -> None:
    """Records and invariants of a mission."""
    schedule = result.schedule
    result.exact.append(check_delivery(out, schedule.lost))
    schedule.lost.clear()
    checked = check_log(out, lambda what, _share: schedule.say(f"{out.name}: {what}"))
    result.facts += sum(row.facts for row in checked.rows)
    result.faults += [f"log check: {row.name}: {row.violation}" for row in checked.rows if row.violation is not None]


def _compare(result: TrialResult, world: World, policy: bytes | None, out: Path) -> None:
    """Hold a mission against the same in lock step: every cell, and the maps and the replay memory of each episode."""
    calm = out.with_name(f"{out.name}-lockstep")
    fly(check(build(UNDISTURBED, world.config), policy), policy, calm, in_one_process=True)
    if queries.digest(out) != queries.digest(calm):
        result.faults.append(f"{out.name} flew other cells than the same mission in lock step")
    states = _states(out)
    for episode, state in _states(calm).items():
        if states.get(episode) != state:
            result.faults.append(
                f"after episode {episode} of {out.name}, maps or replay memory are not as in lock step"
            )
            return


def _states(out: Path) -> dict[int, tuple[str, str, int]]:
    """By episode: digests of the maps and of the replay memory, and how many transitions it holds."""
    found = (entry.message for entry in read(run_files(out)["tmc"], {"/tmc/state"}))
    return {m.episode: (m.map, m.replay, m.transitions) for m in found}


def _sum_up(result: TrialResult, *, trains: bool) -> None:
    """What is to be said of all missions together."""
    schedule, lost, doubled = result.schedule, result.sum("lost"), result.sum("doubled")
    crash = next(iter(schedule.crashes), "")
    kills, backs = sum(schedule.kills.values()), sum(schedule.backs.values())
    sentences = {
        f"{lost:,} records were acknowledged and are lost": lost,
        f"{doubled:,} records were applied twice": doubled,
        f"{kills - backs} of {kills} processes that were killed did not come back": kills - backs,
        f"{len(schedule.crashes)} processes ended by themselves, first: {crash}": schedule.crashes,
        "the training did not go on after the last kill": trains and not schedule.went_on,
    }
    result.faults = [sentence for sentence, so in sentences.items() if so] + result.faults
