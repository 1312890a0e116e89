"""Recompute an episode from the cells that the UAVs reported, independently of the code of TMC and UAVs.

Uncertainty is computed from exponentials of ages, not from the kernel's tables. Only the map, the rates and the
addressed draws are shared with the kernel. Cells without a record (`UNKNOWN`) belong to lost UAVs, or to later ticks.
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
class Rates:
    """Rates of the R monitored cells of K.

    `cells`: (R,), their ids. `index`: (K,), the index of a cell among them, or -1. `alpha`: (R,), event rate, 1/tick.
    `weight`: (R,), reward per uncertainty.
    """

    cells: Ints
    index: list[int]
    alpha: Floats
    weight: Floats


@cache
def rates_of(world: World) -> Rates:
    """Return the rates of a world. The weight is lambda, or with `reward.aligned` scaled to the team's objective."""
    cells = np.flatnonzero(world.alpha > 0)
    index = np.full(world.grid.size, -1)
    index[cells] = np.arange(cells.size)
    alpha, config = world.alpha[cells], world.config
    scale = 1 / (1 - config.dqn.gamma * np.exp(-alpha)) if config.reward.aligned else np.ones(cells.size)
    return Rates(cells, index.tolist(), alpha, config.reward.weight * scale)


def start_factor(e: EpisodeLog) -> Floats:
    """Return 1 - u_k(0) of the monitored cells; shape (R,)."""
    factor = e.world.initial_factor(e.number)
    return np.ones(rates_of(e.world).cells.size) if factor is None else factor


def uncertainty(rates: Rates, start: Floats, last_visit: Ints, t: int) -> Floats:
    """Return u_k(t) by eq. (3), from the ticks of the last visits, 0 for none; shape (R,). `start`: 1 - u_k(0)."""
    return np.asarray(1 - np.where(last_visit == 0, start, 1.0) * np.exp(-rates.alpha * (t - last_visit)))


@dataclass(frozen=True)
class Reference:
    """The true map over an episode, by tick 0..T.

    `uncertainty`: (T + 1,), summed over cells.
    `reward`: (T + 1, N).
    `found`: (T + 1, N), uncertainty of the cell that a UAV entered, before its visit.
    `events`: cells of the new events of each tick.
    `active`: (T + 1, K), True where an event is active; empty in scenario II.
    """

    uncertainty: Floats
    reward: Floats
    found: Floats
    events: list[list[int]]
    active: NDArray[np.bool_]


def truth(e: EpisodeLog) -> Reference:
    """Recompute the true map of an episode."""
    return _truth_1(e) if e.world.config.scenario == 1 else _truth_2(e)


def _truth_2(e: EpisodeLog) -> Reference:
    rates, start = rates_of(e.world), start_factor(e)
    last, total, found = np.zeros(rates.cells.size, np.int64), np.zeros(e.T + 1), np.zeros((e.T + 1, e.N))
    index = np.append(rates.index, -1)
    for t in range(e.T + 1):
        at = index[e.cells[t]]  # UNKNOWN takes the last entry
        monitored = at >= 0
        visited = at[monitored]
        found[t, monitored] = uncertainty(rates, start, last, t)[visited]
        last[visited] = t
        total[t] = uncertainty(rates, start, last, t).sum()
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
    """Return the rewards by eq. (13), shape (T + 1, N): by the true map, or the UAVs' own where the config says so."""
    rules, index = e.world.config.reward, rates_of(e.world).index
    weight = [*rates_of(e.world).weight.tolist(), 0.0]
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
                out[t, i] = rules.new_cell * counted + weight[index[cell]] * u[t][i]
        for i, cell in here:
            own_visits[i].add(cell)
            team_visits.add(cell)
    return out


def maps_handed_out(e: EpisodeLog) -> list[Ints]:
    """Return for each exchange the map that the TMC must hand out: ticks of the last visits it knows, shape (K,)."""
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
    """Return UAV i's rewards by its own map, NaN where it did not move; shape (T + 1,).

    Its own map follows from its cells, its sightings and the maps that it was given.
    """
    config, rates, start = e.world.config, rates_of(e.world), start_factor(e)
    given = {s.tick: m for s, m in zip(e.syncs, maps, strict=True) if i in s.uavs}
    seen: dict[int, list[int]] = {}
    for tick, cell in zip(*e.seen[i], strict=True):
        seen.setdefault(tick, []).append(cell)
    last, visited, out = np.zeros(e.world.grid.size, np.int64), set[int](), np.full(e.T + 1, np.nan)
    weight, alpha, certain = rates.weight.tolist(), rates.alpha.tolist(), start.tolist()
    cells, blocks = e.cells[:, i].tolist(), e.blocks[:, i].tolist()
    for t in range(e.T + 1):
        cell = cells[t]
        if cell == UNKNOWN:
            break
        if t:
            k, tau, u = rates.index[cell], int(last[cell]), 0.0
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
    """Return both sides of the balance of the uncertainty per cell, summed over ticks 1..T; shapes (R,).

    Left: tick by tick, u(t + 1) = 1 - q + q u(t), and 0 at a visit. Right: the sum without visits, less what each visit
    removed, u before it times (1 - q^(T - t + 1)) / (1 - q).
    """
    rates, start = rates_of(e.world), start_factor(e)
    q, index = np.exp(-rates.alpha), np.append(rates.index, -1)
    u, left = 1 - start, np.zeros(rates.cells.size)
    ages = np.arange(1, e.T + 1)
    right = np.array([e.T - s * np.exp(-a * ages).sum() for s, a in zip(start, rates.alpha, strict=True)])
    for t in range(1, e.T + 1):
        at = index[e.cells[t]]
        uavs = np.flatnonzero(at >= 0)
        u = 1 - q + q * u
        for k, i in zip(at[uavs].tolist(), uavs.tolist(), strict=True):
            right[k] -= found[t, i] * -np.expm1(-rates.alpha[k] * (e.T - t + 1)) / -np.expm1(-rates.alpha[k])
        u[at[uavs]] = 0.0
        left += u
    return left, right
