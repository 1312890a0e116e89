"""Invariants of rewards: the UAVs' own, the team's by tick, and the totals at the end of an episode."""

from __future__ import annotations

import numpy as np

from tmc.analysis.invariants.episode_log import UNKNOWN, EpisodeLog
from tmc.analysis.invariants.flight import Fault
from tmc.analysis.invariants.map import SUM_TOLERANCE
from tmc.analysis.invariants.recompute import Reference, maps_handed_out, own_rewards, rates_of
from tmc.analysis.invariants.result import InvariantResult, close, first_violation
from tmc.kernel.reward import Block

FLOAT32_TOLERANCE = 1e-5
"""Largest difference between rewards, and between sums of a team's: the log holds them as float32."""


def own(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """Check the rewards in the records against the UAV's own map: its visits, its sightings and the maps it got."""
    maps, faults, facts = maps_handed_out(e), list[Fault](), 0
    for i in range(e.N):
        expected = own_rewards(e, i, maps, truth.active)
        moved = np.isfinite(expected)
        facts += int(moved.sum())
        for t in np.flatnonzero(moved & ~close(e.own[:, i], expected, FLOAT32_TOLERANCE))[:1].tolist():
            faults.append((t, i, f"{e.own[t, i]:.7g} is recorded, its map gives {expected[t]:.7g}"))
    return first_violation(e, facts, faults)


def team(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """Check the mean reward per UAV by tick against the true map, or the UAVs' own where the config says so."""
    present = (e.cells != UNKNOWN).sum(axis=1)
    mean, faults, facts = truth.reward.sum(axis=1) / np.maximum(present, 1), list[Fault](), 0
    for m in e.metrics:
        for t, value in enumerate(m.reward, m.first):
            facts += 1
            if t > e.T or not close(value, mean[t], FLOAT32_TOLERANCE):
                faults.append((t, None, f"{value:.7g} is logged, moves and map give {mean[min(t, e.T)]:.7g}"))
    return first_violation(e, facts, faults)


def sums(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """Check the totals at the end of an episode: rewards, blocked moves, uncertainty by eq. (6), ticks and steps."""
    faults, facts = list[Fault](), 0
    for end in e.ends:
        for name, logged, expected in _sums(e, truth, end):
            facts += 1
            if not close(logged, expected, SUM_TOLERANCE):
                faults.append((None, None, f"{name} is {logged:.9g} at the end, the ticks give {expected:.9g}"))
        if len(end.reward) != e.N:
            faults.append((None, None, f"it ends with rewards of {len(end.reward)} UAVs of {e.N}"))
    return first_violation(e, facts, faults)


def _sums(e: EpisodeLog, truth: Reference, end: object) -> list[tuple[str, float, float]]:
    mean, cells = truth.uncertainty[1:].sum() / e.T, rates_of(e.world).cells.size
    rewards = truth.reward.sum(axis=0)
    get = end.__getattribute__
    causes = (("blocked_grid", Block.GRID), ("blocked_obstacle", Block.OBSTACLE), ("blocked_uav", Block.UAV))
    rows = [
        ("uncertainty", get("uncertainty"), mean),
        ("uncertainty per road cell", get("uncertainty_per_cell"), mean / cells),
    ]
    rows += [(name.replace("_", " by "), get(name), float((e.blocks == cause).sum())) for name, cause in causes]
    rows += [(f"reward of UAV {i}", value, rewards[i]) for i, value in enumerate(get("reward")) if i < e.N]
    rows += [("ticks", get("ticks"), float(e.T))]
    if e.begins:
        flown = float((e.cells[1:] != UNKNOWN).sum())
        rows += [("steps", get("steps") - e.begins[0].steps, flown)]
    return rows
