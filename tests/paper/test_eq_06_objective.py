"""Sec. II-E: the average uncertainty that the team minimises, from the flown cells alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

Fly = Callable[..., Any]


@pytest.mark.parametrize("period", [1, 10, 50])
def test_eq_06_average_uncertainty_is_that_of_the_true_map(period: int, fly: Fly) -> None:
    """(1/T) sum_t sum_k u_k(t), when the visits were flown and not when they were reported."""
    flown = fly({"comms.period": period})
    roads = flown.world.law.cells
    for episode, cells in flown.cells.items():
        tau, total = np.zeros(flown.world.grid.size), 0.0
        for t in range(1, 38):
            tau[cells[t]] = t
            total += sum(1 - math.exp(-0.01 * (t - tau[k])) for k in roads)
        (end,) = flown.of("/tmc/episode", episode=episode, phase="end")
        assert end["uncertainty"] == pytest.approx(total / 37, abs=1e-9)
        assert end["uncertainty_per_cell"] == pytest.approx(total / 37 / roads.size, abs=1e-9)


def test_eq_06_average_uncertainty_of_scenario_1_counts_active_events(fly: Fly) -> None:
    flown = fly({"scenario": 1, "world.alpha": 0.1})
    (end,) = flown.of("/tmc/episode", episode=2, phase="end")
    assert end["uncertainty"] == pytest.approx(sum(flown.series("uncertainty", 2)[1:]) / 37)


def test_eq_06_falls_with_the_number_of_uavs(fly: Fly) -> None:
    """Fig. 5, in words: the average uncertainty decreases with N."""
    for scenario in (1, 2):
        averages = []
        for n in (1, 4, 10):
            settings = {"scenario": scenario, "team.size": n, "team.controller": "planner:greedy", "world.alpha": 0.05}
            flown = fly({**settings, "training.ticks": 60, "training.episodes": 1})
            averages.append(flown.station.episode_uncertainty)
        assert averages[0] > averages[1] > averages[2]
