"""The replay memory with `replay.priority_exponent`: first priorities by the UAVs' own values, draws that follow,
weights.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from tmc.center import recovery
from tmc.center.episode import RefusedError
from tmc.center.journal import Journal
from tmc.center.priorities import EPSILON
from tmc.center.replay import Replay
from tmc.center.roster import Outbox
from tmc.center.station import Station
from tmc.kernel.roadmap import RoadMap

Nine = Callable[[int, int], list[float]]
T, N, ALPHA, GAMMA, SCALE = 26, 3, 0.6, 0.9, 0.1
VALUES: dict[str, Any] = {
    "training.ticks": T, "training.episodes": 3, "team.size": N, "team.controller": "policy", "comms.period": 7,
    "replay.priority_exponent": ALPHA, "dqn.gamma": GAMMA, "dqn.reward_scale": SCALE, "replay.learn_start": 1,
}  # fmt: skip


def by_hand(flown: Any, worth_of: Nine) -> dict[tuple[int, int, int], float]:
    """(episode, tick, uav) -> |r + gamma max_a' Q(o', a') - Q(o, a)| of all but the last transitions of an episode."""
    found = {}
    for (episode, i), whole in flown.flown().items():
        for t in range(T - 1):
            row = np.array(flown.row(episode, t + 1))
            r = SCALE * float(flown.station.replay.rewards[row][i])
            q = worth_of(t, whole["cells"][t])[whole["actions"][t]]
            following = worth_of(t + 1, whole["cells"][t + 1])
            best = max(following[a] for a in flown.seen[episode, t + 1, i][1])
            found[episode, t, i] = abs(r + GAMMA * best - q)
    return found


def masses(replay: Replay) -> dict[tuple[int, int, int], float]:
    """(episode, tick, uav) -> the mass of each transition held."""
    assert replay.priorities is not None
    held = len(replay) // N
    place = np.arange(replay.starts_in - held, replay.starts_in)
    row = replay.starts[place]
    mass = replay.priorities.mass(place[:, None] * N + np.arange(N))
    keys = zip(replay.episode[row].tolist(), replay.tick[row].tolist(), mass.tolist(), strict=True)
    return {(e, t, i): m for e, t, row_ in keys for i, m in enumerate(row_)}


@pytest.mark.parametrize("phase", ["together", "staggered"])
@pytest.mark.parametrize(("n_step", "masked", "capacity"), [(1, False, 9999), (3, True, 9999), (1, True, 75)])
def test_first_priorities_are_the_errors_of_who_flew_it(
    mission: Callable[..., Any], town: RoadMap, worth_of: Nine, n_step: int, masked: bool, capacity: int, phase: str
) -> None:
    """In any interleaving, with UAVs that are killed in between; the last of an episode keeps the largest so far."""
    values = {"dqn.n_step": n_step, "exploration.mask_blocked": masked, "replay.capacity": capacity}
    flown = mission({**VALUES, **values, "comms.phase": phase}, town).play(Random(n_step), crash=0.01)
    errors = by_hand(flown, worth_of)
    expected = {key: (error + EPSILON) ** ALPHA for key, error in errors.items()}
    found = masses(flown.station.replay)
    assert len(found) == min(capacity, 3 * T * N)
    for key, mass in found.items():
        if key[1] < T - 1:
            assert mass == pytest.approx(expected[key], rel=1e-5), key
        else:
            assert mass == pytest.approx(1.0) or any(mass == pytest.approx(m, rel=1e-5) for m in expected.values())


@pytest.fixture(scope="module")
def filled(mission: Callable[..., Any], town: RoadMap) -> Replay:
    replay: Replay = mission({**VALUES, "replay.capacity": 120}, town).play(Random(2)).station.replay
    return replay


def test_draws_follow_the_priorities(filled: Replay) -> None:
    """Over many minibatches each transition is drawn in proportion to its mass; the oldest are gone."""
    mass, counts = masses(filled), dict.fromkeys(masses(filled), 0)
    for number in range(200):
        s = filled.sample(number, 150)
        ticks, episodes = filled.tick[s.row].tolist(), filled.episode[s.row].tolist()
        for key in zip(episodes, ticks, s.uav.tolist(), strict=True):
            counts[key] += 1
    total = sum(mass.values())
    expected = {key: 200 * 150 * m / total for key, m in mass.items()}
    assert len(mass) == 120 and min(counts.values()) > 0
    # Drawn evenly over the mass, numbers stray less than by chance alone: a third of what chi-squared would allow.
    assert sum((counts[k] - e) ** 2 / e for k, e in expected.items()) < 60
    assert max(counts.values()) > 3 * min(counts.values())


def test_a_prioritised_minibatch_is_drawn_again_by_its_number_and_is_whole(filled: Replay) -> None:
    s, again = filled.sample(5, 32), filled.sample(5, 32)
    assert s.index.tolist() == again.index.tolist() != filled.sample(6, 32).index.tolist()
    place, uav = np.divmod(s.index, N)
    assert (filled.starts[place] == s.row).all() and (uav == s.uav).all()
    plain = filled.rebuild(place, uav, s.weight)
    assert plain.views.u.tobytes() == s.views.u.tobytes() and plain.reward.tobytes() == s.reward.tobytes()


def test_weights_make_up_for_it(filled: Replay) -> None:
    s = filled.sample(7, 64)
    assert filled.priorities is not None
    mass = filled.priorities.mass(s.index)
    assert s.weight.dtype == np.float32 and s.weight == pytest.approx((mass / mass.min()) ** -0.4, rel=1e-6)


def test_without_priorities_a_record_has_no_values(mission: Callable[..., Any], town: RoadMap) -> None:
    """Nor has a planner's; and the draws are those of a replay that knows nothing of priorities."""
    off = mission({**VALUES, "replay.priority_exponent": 0.0}, town).play()
    planner = mission({**VALUES, "team.controller": "planner:greedy"}, town).play()
    on = mission(VALUES, town).play()
    assert {r.values.size for r in off.records + planner.records} == {0}
    assert all(r.values.size == 2 * r.actions.size for r in on.records)
    assert off.flown() == on.flown()
    assert off.station.replay.digest() == on.station.replay.digest()
    assert off.station.replay.sample(0, 8).weight.size == 0


@pytest.mark.parametrize("size", [0, 1, 3])
def test_a_record_with_other_values_than_moves_is_refused(
    mission: Callable[..., Any], town: RoadMap, size: int
) -> None:
    flown = mission(VALUES, town)
    for what, _ in flown.steps():
        episode = flown.station.episode
        if what == "fly" and flown.up[0] and episode is not None and episode.done > 0:
            record = flown.up[0][-1]
            assert record.actions.size > 2
            with pytest.raises(RefusedError, match="values of 7 moves"):
                episode.accept(dataclasses.replace(record, values=record.values[:size]))
            return
    pytest.fail("no record was seen")


def test_a_recovered_tmc_has_the_first_priorities(mission: Callable[..., Any], town: RoadMap, tmp_path: Path) -> None:
    flown = mission(VALUES, town).play(Random(5))
    journal = Journal(tmp_path, flown.world, "run")
    journal.take(Outbox(entries=flown.entries[: len(flown.entries) * 2 // 3]))
    journal.writer.close()
    station = Station(flown.world, "run", learning=False, policy=b"policy")
    recovery.recover(station, tmp_path / "tmc.mcap", 1.0)
    before, after = masses(flown.station.replay), masses(station.replay)
    with_errors = {key for key in after if key[1] < T - 1 and (key[0], key[1] + 2, key[2]) in after}
    assert 50 < len(with_errors) < len(before)
    assert {key: after[key] for key in with_errors} == {key: before[key] for key in with_errors}
