"""The whole trial: missions under a storm, one after the other until it is over, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from deploy.run.mission import bound_of, check, command_line, interrupted
from deploy.verify.chaos.checker import Exactness, judge
from deploy.verify.chaos.mission import Disturbed
from deploy.verify.chaos.schedule import Storm
from deploy.verify.exactness import Quiet, fly
from tmc.analysis.invariants.check import check as check_log
from tmc.kernel.config import Config, build
from tmc.kernel.world import World
from tmc.record import facts
from tmc.record.reader import read, run_files
from tmc.wire import process

TRAIN: dict[str, Any] = {
    "team.size": 3, "trial.oath": True, "training.episodes": 1_000_000, "training.checkpoint_every": 200,
}  # fmt: skip
"""A training that does not end by itself, whose learner loses little with each kill."""
FLY: dict[str, Any] = {
    "team.size": 3, "trial.oath": True, "training.episodes": 4, "trial.stall": 0.003, "trial.stall_share": 1.0,
}  # fmt: skip
"""Missions that take some ten seconds undisturbed."""
CALM: dict[str, Any] = {"trial.oath": False, "trial.ack_early": False, "trial.stall": 0.0}
"""The same mission in lock step, for comparison."""


class Hushed(Quiet):
    """Shows nothing; notes go to the diary."""

    storm: Storm

    def work(self, what: str, share: float) -> None: ...

    def note(self, text: str) -> None:
        self.storm.write(text)
        self.storm.failures.append(text)


@dataclass
class Verdict:
    """What came of the trial; `faults`: sentences, none when all is well."""

    storm: Storm
    missions: int = 0
    exact: list[Exactness] = field(default_factory=list)
    facts: int = 0
    """Facts that `log check` compared."""
    faults: list[str] = field(default_factory=list)

    def sum(self, what: str) -> int:
        """Of all missions, one of the counts of Exactness."""
        return sum(getattr(exact, what) for exact in self.exact)


def run(config: Config, policy: bytes | None, place: Path, storm: Storm, *, trains: bool) -> Verdict:
    """One training, or mission after mission until the storm is over; their folders are in `place`.

    Raises KeyboardInterrupt when the user stops it.
    """
    verdict = Verdict(storm)
    while storm.next is not None and not verdict.faults:
        seed = config.training.seed + verdict.missions
        world = check(build({"training.seed": seed}, config), policy)
        verdict.missions += 1
        out = place / f"mission-{verdict.missions}"
        code = _weather(world, policy, out, storm, lasts=not trains)
        if code not in (process.DONE, process.FAILED):
            raise KeyboardInterrupt
        verdict.faults += storm.failures
        _judge(verdict, out)
        if not trains and code == process.DONE:
            _compare(verdict, world, policy, out)
    _sum_up(verdict, trains=trains)
    return verdict


def _weather(world: World, policy: bytes | None, out: Path, storm: Storm, *, lasts: bool) -> int:
    """One mission, taken up again after each power cut; returns its exit code."""
    out.mkdir()
    while True:
        progress = Hushed(world.config, world.law.cells.size, bound_of(world))
        mission = Disturbed(world, out, command_line(), policy, progress)
        progress.storm = mission.storm = storm
        mission.lasts = lasts
        code = mission.run(in_one_process=False)
        if code != process.DONE or storm.dark is None:
            return code
        world, policy = interrupted(out)


def _judge(verdict: Verdict, out: Path) -> None:
    """Records and invariants of a mission."""
    storm = verdict.storm
    verdict.exact.append(judge(out, storm.lost))
    storm.lost.clear()
    result = check_log(out, lambda what, _share: storm.say(f"{out.name}: {what}"))
    verdict.facts += sum(row.facts for row in result.rows)
    verdict.faults += [f"log check: {row.name}: {row.violation}" for row in result.rows if row.violation is not None]


def _compare(verdict: Verdict, world: World, policy: bytes | None, out: Path) -> None:
    """Hold a mission against the same in lock step: every cell, and the maps and the replay memory of each episode."""
    calm = out.with_name(f"{out.name}-lockstep")
    fly(check(build(CALM, world.config), policy), policy, calm, in_one_process=True)
    if facts.digest(out) != facts.digest(calm):
        verdict.faults.append(f"{out.name} flew other cells than the same mission in lock step")
    states = _states(out)
    for episode, state in _states(calm).items():
        if states.get(episode) != state:
            verdict.faults.append(
                f"after episode {episode} of {out.name}, maps or replay memory are not as in lock step"
            )
            return


def _states(out: Path) -> dict[int, tuple[str, str, int]]:
    """By episode: digests of the maps and of the replay memory, and how many transitions it holds."""
    found = (entry.message for entry in read(run_files(out)["tmc"], {"/tmc/state"}))
    return {m.episode: (m.map, m.replay, m.transitions) for m in found}


def _sum_up(verdict: Verdict, *, trains: bool) -> None:
    """What is to be said of all missions together."""
    storm, lost, doubled = verdict.storm, verdict.sum("lost"), verdict.sum("doubled")
    kills, backs = sum(storm.kills.values()), sum(storm.backs.values())
    sentences = {
        f"{lost:,} records were acknowledged and are lost": lost,
        f"{doubled:,} records were applied twice": doubled,
        f"{kills - backs} of {kills} processes that were killed did not come back": kills - backs,
        f"{len(storm.crashes)} processes ended by themselves, first: {next(iter(storm.crashes), '')}": storm.crashes,
        "the training did not go on after the last kill": trains and not storm.went_on,
    }
    verdict.faults = [sentence for sentence, so in sentences.items() if so] + verdict.faults
