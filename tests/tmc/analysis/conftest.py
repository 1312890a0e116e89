"""What the tests of analysis share: a few small missions, flown in lock step."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from deploy.lockstep import run
from deploy.progress import Progress
from tmc.kernel.config import build, flat
from tmc.kernel.world import World

SMALL = {
    "training.ticks": 60,
    "training.seed": 3,
    "team.size": 3,
    "team.pilot": "planner:greedy",
    "exploration.start": 0.4,
    "exploration.end": 0.4,
}
"""With exploration, so that moves are blocked for every cause."""
LEARNING = {
    **SMALL,
    "team.pilot": "policy",
    "training.episodes": 3,
    "training.push_every": 10,
    "dqn.batch": 8,
    "replay.learn_start": 16,
    "observation.view": "ego",
    "observation.radius": 4,
    "network.channels": [4],
    "network.dense": 8,
}


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


@pytest.fixture(scope="session")
def learned(fly: Callable[..., Path]) -> Path:
    """A short training run."""
    return fly(**LEARNING)
