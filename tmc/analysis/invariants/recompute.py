"""What must have been, reckoned from the cells that UAVs reported: apart from the code that the TMC and the UAVs run.

Uncertainty comes from exponentials of ages, not from the kernel's tables; shared with it are the map, the rates and the
addressed draws. Cells without a record (`UNKNOWN`) belong to UAVs that were lost, or to ticks still to come.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from tmc.analysis.invariants.episode_log import UNKNOWN, EpisodeLog
from tmc.kernel.world import World

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Law:
    """`cells`: (R,), the monitored ones; `place`: (K,), where a cell stands among them, or -1; the rest: (R,)."""

    cells: Ints
    place: list[int]
    alpha: Floats
    weight: Floats


@cache
def law_of(world: World) -> Law:
    """Rates of the monitored cells, and what their uncertainty earns: lambda, or aligned with the team's objective."""
    cells = np.flatnonzero(world.alpha > 0)
    place = np.full(world.grid.size, -1)
    place[cells] = np.arange(cells.size)
    alpha, config = world.alpha[cells], world.config
    scale = 1 / (1 - config.dqn.gamma * np.exp(-alpha)) if config.reward.aligned else np.ones(cells.size)
    return Law(cells, place.tolist(), alpha, config.reward.weight * scale)


def start_factor(e: EpisodeLog) -> Floats:
    """(R,): what is left of certainty at t = 0, 1 - u_k(0)."""
    factor = e.world.initial_factor(e.number)
    return np.ones(law_of(e.world).cells.size) if factor is None else factor


def uncertainty(law: Law, start: Floats, last_visit: Ints, t: int) -> Floats:
    """Eq. (3): (R,) from the ticks of the last visits; `start` counts where there was none since."""
    return np.asarray(1 - np.where(last_visit == 0, start, 1.0) * np.exp(-law.alpha * (t - last_visit)))


@dataclass(frozen=True)
class Reference:
    """The true map over an episode, entry by tick 0..T: sum over cells, rewards (T + 1, N), new events of each tick.

    `active`: scenario I, (T + 1, K), the events that are on; `found`: (T + 1, N), uncertainty of the cell that a UAV
    entered, before the visit.
    """

    uncertainty: Floats
    reward: Floats
    found: Floats
    events: list[list[int]]
    active: NDArray[np.bool_]


def truth(e: EpisodeLog) -> Reference:
    """Fly the episode again over the true map."""
    return _truth_1(e) if e.world.config.scenario == 1 else _truth_2(e)


def _truth_2(e: EpisodeLog) -> Reference:
    law, start = law_of(e.world), start_factor(e)
    last, total, found = np.zeros(law.cells.size, np.int64), np.zeros(e.T + 1), np.zeros((e.T + 1, e.N))
    place = np.append(law.place, -1)
    for t in range(e.T + 1):
        at = place[e.cells[t]]  # UNKNOWN takes the last entry
        monitored = at >= 0
        visited = at[monitored]
        found[t, monitored] = uncertainty(law, start, last, t)[visited]
        last[visited] = t
        total[t] = uncertainty(law, start, last, t).sum()
    return Reference(total, rewards(e, found), found, [], np.zeros((0, 0), bool))


def _truth_1(e: EpisodeLog) -> Reference:
    K = e.world.grid.size
    active, total, found = np.zeros((e.T + 1, K), bool), np.zeros(e.T + 1), np.zeros((e.T + 1, e.N))
    events: list[list[int]] = [[]]
    for t in range(1, e.T + 1):
        cells = e.cells[t]
        here = cells != UNKNOWN
        found[t, here] = active[t - 1, cells[here]]
        left = active[t - 1].copy()
        left[cells[here]] = False
        new = e.world.arrivals(e.number, t) & ~left
        active[t] = left | new
        total[t] = active[t].sum()
        events.append(np.flatnonzero(new).tolist())
    return Reference(total, rewards(e, found), found, events, active)


def rewards(e: EpisodeLog, found: Floats) -> Floats:
    """(T + 1, N): eq. (13) by the true map, or with the UAVs' own reckoning where the config says so."""
    rules, place = e.world.config.reward, law_of(e.world).place
    weight = [*law_of(e.world).weight.tolist(), 0.0]
    out, own_visits, team_visits = np.zeros((e.T + 1, e.N)), [set[int]() for _ in range(e.N)], set[int]()
    cells, blocks, u = e.cells.tolist(), e.blocks.tolist(), found.tolist()
    for t in range(e.T + 1):
        here = [(i, cell) for i, cell in enumerate(cells[t]) if cell != UNKNOWN]
        for i, cell in here if t else []:
            novel = cell not in own_visits[i]
            counted = novel if rules.novelty == "own" else cell not in team_visits
            if blocks[t][i] > 0:
                out[t, i] = rules.collision
            elif rules.uncertainty == "own":
                out[t, i] = e.own[t, i] + rules.new_cell * (counted - novel)
            else:
                out[t, i] = rules.new_cell * counted + weight[place[cell]] * u[t][i]
        for i, cell in here:
            own_visits[i].add(cell)
            team_visits.add(cell)
    return out


def maps_handed_out(e: EpisodeLog) -> list[Ints]:
    """For each exchange the map that its tick and its UAVs make, (K,): ticks of the last visits that the TMC knows."""
    believed, known = np.zeros(e.world.grid.size, np.int64), [-1] * e.N
    monitored = e.world.alpha > 0
    maps = []
    for sync in e.syncs:
        for i in (i for i in sync.uavs if i < e.N):
            track = e.cells[known[i] + 1 : sync.tick + 1, i]
            ticks = np.arange(known[i] + 1, known[i] + 1 + track.size)[track != UNKNOWN]
            np.maximum.at(believed, track[track != UNKNOWN], ticks)
            known[i] = max(known[i], sync.tick)
        maps.append(np.where(monitored, believed, 0))
    return maps


def own_rewards(e: EpisodeLog, i: int, maps: list[Ints], active: NDArray[np.bool_]) -> Floats:
    """(T + 1,): UAV i's reward by its own map, from where it was, what it saw and the maps that it was given; NaN where
    it did not move."""
    config, law, start = e.world.config, law_of(e.world), start_factor(e)
    given = {s.tick: m for s, m in zip(e.syncs, maps, strict=True) if i in s.uavs}
    seen: dict[int, list[int]] = {}
    for tick, cell in zip(*e.seen[i], strict=True):
        seen.setdefault(tick, []).append(cell)
    last, visited, out = np.zeros(e.world.grid.size, np.int64), set[int](), np.full(e.T + 1, np.nan)
    weight, alpha, certain = law.weight.tolist(), law.alpha.tolist(), start.tolist()
    cells, blocks = e.cells[:, i].tolist(), e.blocks[:, i].tolist()
    for t in range(e.T + 1):
        cell = cells[t]
        if cell == UNKNOWN:
            break
        if t:
            k, tau, u = law.place[cell], int(last[cell]), 0.0
            if k >= 0 and config.scenario == 1:
                u = float(active[t - 1, cell])
            elif k >= 0:
                u = 1 - (1.0 if tau else certain[k]) * float(np.exp(-alpha[k] * (t - tau)))
            earned = config.reward.new_cell * (cell not in visited) + (weight[k] * u if k >= 0 else 0.0)
            out[t] = config.reward.collision if blocks[t] > 0 else earned
        visited.add(cell)
        last[[cell, *seen.get(t, [])]] = t
        if t in given:
            np.maximum(last, given[t], out=last)
    return out


def accounts(e: EpisodeLog, found: Floats) -> tuple[Floats, Floats]:
    """The accounting identity of the log, both sides by cell, (R,): the sum over ticks 1..T of the uncertainty.

    Left: tick by tick, u(t + 1) = 1 - q + q u(t), and 0 at a visit. Right: the sum had nobody come, less what each
    visit took away, u before it times (1 - q^(T - t + 1)) / (1 - q).
    """
    law, start = law_of(e.world), start_factor(e)
    q, place = np.exp(-law.alpha), np.append(law.place, -1)
    u, left = 1 - start, np.zeros(law.cells.size)
    ages = np.arange(1, e.T + 1)
    right = np.array([e.T - s * np.exp(-a * ages).sum() for s, a in zip(start, law.alpha, strict=True)])
    for t in range(1, e.T + 1):
        at = place[e.cells[t]]
        uavs = np.flatnonzero(at >= 0)
        u = 1 - q + q * u
        for k, i in zip(at[uavs].tolist(), uavs.tolist(), strict=True):
            right[k] -= found[t, i] * -np.expm1(-law.alpha[k] * (e.T - t + 1)) / -np.expm1(-law.alpha[k])
        u[at[uavs]] = 0.0
        left += u
    return left, right
