"""What the tests of analysis share: a few small missions, flown in lock step."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from deploy.run.lockstep import run
from deploy.run.progress import Progress
from tmc.kernel.config import JournalConfig, build, flat
from tmc.kernel.world import World
from tmc.record import overfly_pb2
from tmc.record.reader import Log
from tmc.record.writer import LogWriter

SMALL = {
    "training.ticks": 60,
    "training.seed": 3,
    "training.episodes": 1,
    "team.size": 3,
    "team.controller": "planner:random",
}
"""At random, so that moves are blocked for every cause, and UAVs leave the roads."""


@pytest.fixture(scope="session")
def fly(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A run folder of a mission with dotted keys replaced; the same folder for the same mission: do not change it."""
    made: dict[str, Path] = {}

    def make(**values: object) -> Path:
        config = build({**SMALL, **values})
        key = str(flat(config))
        if key not in made:
            folder = tmp_path_factory.mktemp("run")
            (folder / "config.json").write_text(json.dumps(flat(config)))
            world = World(config)
            run(world, folder, None, Progress(config, world.law.cells.size, 0.0))
            made[key] = folder
        return made[key]

    return make


def flown_as(old: Path, new: Path, change: dict[str, object]) -> None:
    """A copy of a run with settings changed, in the log and in a `config.json` beside it."""
    new.mkdir()
    was = Log(old / "tmc.mcap")
    config = next(json.loads(a.data) for a in was.attachments() if a.name == "config.json")
    text = json.dumps(config | change)
    (new / "config.json").write_text(text)
    with LogWriter(new / "tmc.mcap", "tmc", JournalConfig(), was.metadata()) as log:
        for a in was.attachments():
            log.attach(a.name, a.media_type, text.encode() if a.name == "config.json" else a.data)
        for raw in was.raw():
            log.put(raw.topic, raw.data, raw.log_time, raw.publish_time, raw.sequence)


@pytest.fixture(scope="session")
def learned(fly: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that looks like training, without torch: three random episodes, and the log of a learner."""
    folder = tmp_path_factory.mktemp("learned") / "run"
    flown_as(fly(**{"training.episodes": 3}), folder, {"team.controller": "policy"})
    with LogWriter(folder / "learner.mcap", "learner", JournalConfig(), {}) as log:
        for n in range(1, 181):
            metrics = overfly_pb2.LearnerMetrics(updates=n, loss=1 / n, q_mean=n / 20, target_mean=n / 19)
            log.write("/learner/metrics", metrics)
    return folder
