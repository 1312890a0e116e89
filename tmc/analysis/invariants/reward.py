"""Invariants of rewards: the UAVs' own, the team's by tick, and the sums at an episode's end."""

from __future__ import annotations

import numpy as np

from tmc.analysis.invariants.episode_log import UNKNOWN, EpisodeLog
from tmc.analysis.invariants.flight import Fault
from tmc.analysis.invariants.map import EXACT
from tmc.analysis.invariants.recompute import Reference, law_of, maps_handed_out, own_rewards
from tmc.analysis.invariants.result import InvariantResult, close, first_violation
from tmc.kernel.reward import Block

SINGLE = 1e-5
"""Rewards are logged with 24 bits: these, and sums of a team of them, are equal up to this."""


def own(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """The rewards in a record are those by the UAV's own map: its visits, its sightings and the maps it was given."""
    maps, faults, facts = maps_handed_out(e), list[Fault](), 0
    for i in range(e.N):
        expected = own_rewards(e, i, maps, truth.active)
        moved = np.isfinite(expected)
        facts += int(moved.sum())
        for t in np.flatnonzero(moved & ~close(e.own[:, i], expected, SINGLE))[:1].tolist():
            faults.append((t, i, f"it reckons {e.own[t, i]:.7g}, its map makes {expected[t]:.7g}"))
    return first_violation(e, facts, faults)


def team(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """The mean reward of the team by tick follows from the true map, or from the UAVs' own where the config says so."""
    present = (e.cells != UNKNOWN).sum(axis=1)
    mean, faults, facts = truth.reward.sum(axis=1) / np.maximum(present, 1), list[Fault](), 0
    for m in e.metrics:
        for t, value in enumerate(m.reward, m.first):
            facts += 1
            if t > e.T or not close(value, mean[t], SINGLE):
                faults.append((t, None, f"{value:.7g} is logged, moves and map make {mean[min(t, e.T)]:.7g}"))
    return first_violation(e, facts, faults)


def sums(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """What an episode's end says: rewards by UAV, blocked moves by cause, uncertainty by eq. (6), ticks and steps."""
    faults, facts = list[Fault](), 0
    for end in e.ends:
        for name, logged, made in _sums(e, truth, end):
            facts += 1
            if not close(logged, made, EXACT):
                faults.append((None, None, f"{name} is {logged:.9g} at the end, the ticks make {made:.9g}"))
        if len(end.reward) != e.N:
            faults.append((None, None, f"it ends with rewards of {len(end.reward)} UAVs of {e.N}"))
    return first_violation(e, facts, faults)


def _sums(e: EpisodeLog, truth: Reference, end: object) -> list[tuple[str, float, float]]:
    mean, cells = truth.uncertainty[1:].sum() / e.T, law_of(e.world).cells.size
    rewards = truth.reward.sum(axis=0)
    get = end.__getattribute__
    causes = (("blocked_grid", Block.GRID), ("blocked_obstacle", Block.OBSTACLE), ("blocked_uav", Block.UAV))
    rows = [
        ("uncertainty", get("uncertainty"), mean),
        ("uncertainty a road cell", get("uncertainty_per_cell"), mean / cells),
    ]
    rows += [(name.replace("_", " by "), get(name), float((e.blocks == cause).sum())) for name, cause in causes]
    rows += [(f"reward of UAV {i}", value, rewards[i]) for i, value in enumerate(get("reward")) if i < e.N]
    rows += [("ticks", get("ticks"), float(e.T))]
    if e.begins:
        flown = float((e.cells[1:] != UNKNOWN).sum())
        rows += [("steps", get("steps") - e.begins[0].steps, flown)]
    return rows
