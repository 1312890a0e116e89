"""A training that would learn nothing is told from one that learns, by its settings alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from deploy.run.lockstep import LockStep
from tmc.kernel import forecast
from tmc.kernel.config import build
from tmc.kernel.roadmap import parse_raster
from tmc.kernel.world import World

SHORT = {"team.size": 2, "training.ticks": 20, "training.episodes": 2, "comms.period": 5, "dqn.target_episodes": 1}


def idle(**values: Any) -> str:
    return forecast.idle(build({**SHORT, "replay.learn_start": 10, **values})) or ""


def test_a_training_that_learns_is_let_through() -> None:
    assert idle() == "" and forecast.idle(build({})) is None


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"replay.updates_per_tick": 0.0}, "replay.updates_per_tick = 0, so nothing would be learned"),
        ({"replay.learn_start": 81}, "the mission makes 80 transitions in 40 ticks"),
        ({"replay.learn_start": 80}, "replay.learn_start = 80 of them would be in at tick 40"),
        ({"replay.updates_per_tick": 1e-6}, "nothing would be learned"),
        ({"dqn.target_episodes": 3}, "dqn.target_episodes = 3 is above training.episodes = 2"),
        ({"dqn.target_episodes": 3, "dqn.target_updates": 5}, ""),
        ({"dqn.target_episodes": 2}, ""),
        ({"replay.learn_start": 70}, ""),
    ],
)
def test_what_would_learn_nothing_is_refused_with_its_figures(values: dict[str, Any], words: str) -> None:
    assert words in idle(**values) and bool(words) == bool(idle(**values))


def test_what_a_training_will_not_do_is_said() -> None:
    def remarks(**values: Any) -> list[str]:
        return list(forecast.remarks(build({**SHORT, "replay.learn_start": 10, "training.publish_every": 5, **values})))

    made = forecast.updates(build({**SHORT, "replay.learn_start": 10}))
    assert remarks() == []
    [never] = remarks(**{"training.publish_every": made + 1})
    assert f"{made} updates" in never and "policies/final.onnx alone" in never
    [still] = remarks(**{"dqn.target_episodes": 0, "dqn.target_updates": made + 1})
    assert "the target network stays as it is at the start" in still


class Counting:
    """A trainer that only counts."""

    def __init__(self) -> None:
        self.updates = self.version = 0

    def update(self, _batch: Any) -> Any:
        self.updates += 1
        return type("Metrics", (), {"updates": self.updates, "loss": 0.0})

    def policy(self) -> tuple[int, bytes]:
        self.version += 1
        return self.version, b"model"

    def take_td_errors(self) -> tuple[Any, Any]:
        return np.zeros(0, np.int64), np.zeros(0, np.float32)


class Stay:
    """Any policy: it stays where it is."""

    def choose(self, _sight: Any) -> int:
        return 8


MISSIONS = {
    "team.size": st.integers(1, 3),
    "training.ticks": st.integers(1, 12),
    "training.episodes": st.integers(1, 3),
    "comms.period": st.integers(1, 15),
    "comms.phase": st.sampled_from(["together", "staggered"]),
    "replay.learn_start": st.integers(1, 60),
    "replay.updates_per_tick": st.sampled_from([0.3, 1.0, 2.5]),
    "dqn.n_step": st.integers(1, 4),
}


@example(
    {
        "team.size": 2,
        "training.ticks": 6,
        "training.episodes": 1,
        "comms.period": 3,
        "comms.phase": "staggered",
        "replay.learn_start": 1,
        "replay.updates_per_tick": 1.0,
        "dqn.n_step": 4,
    }
)  # the first at the end starts it
@given(st.fixed_dictionaries(MISSIONS))
def test_the_updates_that_a_training_makes_are_known_before(values: dict[str, Any]) -> None:
    """Exactly as many as were said where all UAVs exchange together, never more where they do so in turn."""
    config = build(values)
    flown = LockStep(World(config, parse_raster("####\n#..#\n####")), None, lambda _: None, trainer := Counting())
    flown._builder = type("BatchBuilder", (), {"build": staticmethod(lambda batch: batch)})()
    for pilot in flown.fleet.pilots:
        pilot._make_controller = lambda _: Stay()
    flown.run()
    said = forecast.updates(config)
    assert trainer.updates == said if values["comms.phase"] == "together" else trainer.updates <= said
