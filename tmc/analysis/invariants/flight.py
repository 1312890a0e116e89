"""Invariants of flight records: they are complete, their moves are possible, and their sightings are right."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tmc.analysis.invariants.episode_log import UNKNOWN, EpisodeLog
from tmc.analysis.invariants.result import InvariantResult, first_violation, where_first
from tmc.kernel.grid import ACTIONS, STAY
from tmc.kernel.reward import Block
from tmc.record.overfly_pb2 import Episode

Ints = NDArray[np.int64]
Fault = tuple[int | None, int | None, str]


def episodes(e: EpisodeLog) -> InvariantResult:
    """Check that episodes are numbered from 1, begun once and, except the last, ended once, without anomalies."""
    faults: list[Fault] = list(e.anomalies)
    if e.number != e.before.number + 1:
        faults.append((None, None, f"it follows episode {e.before.number}"))
    if not e.begins or any(m != e.begins[0] for m in e.begins):
        faults.append((None, None, f"{len(e.begins)} different messages begin it"))
    if len(e.ends) > 1 or not (e.ends or e.last):
        faults.append((None, None, f"{len(e.ends)} messages end it"))
    faults += [
        (None, None, "its begin has totals of moves that were not flown yet") for m in e.begins if not _fresh(e, m)
    ]
    return first_violation(e, len(e.begins) + len(e.ends), faults)


def _fresh(e: EpisodeLog, m: Episode) -> bool:
    sums = (m.ticks, m.uncertainty, m.uncertainty_per_cell, m.blocked_grid, m.blocked_obstacle, m.blocked_uav)
    return not any(sums) and list(m.reward) == [0.0] * e.N


def starts(e: EpisodeLog) -> InvariantResult:
    """Check that the cells at tick 0, and those logged at the begin, are the draws of the seed."""
    drawn = e.world.starts(e.number)
    logged = [list(m.starts) for m in (*e.begins, *e.ends)]
    faults: list[Fault] = [
        (0, None, f"its starts are {cells}, the seed draws {drawn}") for cells in logged if cells != drawn
    ]
    here = e.cells[0] != UNKNOWN
    wrong = np.flatnonzero(here & (e.cells[0] != drawn))
    faults += [(0, int(i), f"it starts on cell {e.cells[0, i]}, the seed draws {drawn[i]}") for i in wrong]
    return first_violation(e, int(here.sum()) + len(logged), faults)


def sequence(e: EpisodeLog) -> InvariantResult:
    """Check that the numbers of a UAV's records go up by one, over all episodes."""
    following, faults = dict(e.before.sequence), []
    for r in e.records:
        wanted = following.get(r.uav, 0)
        if r.sequence != wanted:
            faults.append((r.tick, r.uav, f"record {r.sequence} follows where {wanted} is next"))
        following[r.uav] = r.sequence + 1
    return first_violation(e, len(e.records), faults)


def ticks(e: EpisodeLog) -> InvariantResult:
    """Check that a UAV's records cover each tick once."""
    reported, faults = [-1] * e.N, []
    for r in e.records:
        if r.first != reported[r.uav] + 1:
            faults.append(
                (r.first, r.uav, f"a record begins at tick {r.first}, the one before ends at {reported[r.uav]}")
            )
        reported[r.uav] = r.tick
    return first_violation(e, len(e.records), faults)


def cadence(e: EpisodeLog) -> InvariantResult:
    """Check that every record ends at the first tick at which its UAV is due."""
    config = e.world.config
    faults: list[Fault] = []
    for r in e.records:
        due = next((t for t in range(r.first, e.T + 1) if config.due(r.uav, t)), e.T)
        if r.tick != due:
            faults.append((r.tick, r.uav, f"a record ends at tick {r.tick}, it is due at {due}"))
    return first_violation(e, len(e.records), faults)


def lost(e: EpisodeLog) -> InvariantResult:
    """Check that a UAV is lost once, after its last record, and that a UAV whose records end early is lost."""
    faults: list[Fault] = []
    logged = [i for i, *_ in e.lost]
    for i, tick, reported in e.lost:
        if tick != reported or e.reported[i] != reported:
            faults.append((tick, i, f"it is lost after tick {tick}; its records end at tick {e.reported[i]}"))
        if logged.count(i) > 1:
            faults.append((tick, i, "it is lost twice"))
    missing = [i for i in range(e.N) if e.reported[i] < e.T and i not in logged]
    faults += [(e.reported[i], i, "its records end here, but it was not lost") for i in missing if e.ended]
    return first_violation(e, e.N, faults)


def moves(e: EpisodeLog) -> InvariantResult:
    """Check that each cell follows from the one before by the action, or is the same where the move was blocked.

    Edges, obstacles and no-fly cells block; otherwise only a UAV does.
    """
    before, after, action, block = e.cells[:-1], e.cells[1:], e.actions[1:], e.blocks[1:]
    known = (before != UNKNOWN) & (after != UNKNOWN)
    target, static = _static(e, before, action)
    expected = np.where(block == Block.NONE, target, before)
    jump = known & (expected != after)
    untrue = known & (static != np.where(block == Block.UAV, Block.NONE, block))
    stay_blocked = known & (block == Block.UAV) & (action == STAY)
    on_obstacle = (e.cells != UNKNOWN) & e.world.map.blocked[e.cells]
    faults: list[Fault] = [(t + 1, i, f"it goes from cell {before[t, i]} to {after[t, i]} by {_move(e, t, i)}")
                           for t, i in where_first(jump)]  # fmt: skip
    faults += [(t + 1, i, f"by the map, its move from cell {before[t, i]} is not {_move(e, t, i)}")
               for t, i in where_first(untrue)]  # fmt: skip
    faults += [(t + 1, i, "another UAV blocks it from staying on its cell") for t, i in where_first(stay_blocked)]
    faults += [(t, i, f"it stands on the obstacle of cell {e.cells[t, i]}") for t, i in where_first(on_obstacle)]
    return first_violation(e, int(known.sum()), faults)


def _move(e: EpisodeLog, t: int, i: int) -> str:
    action, block = e.actions[t + 1, i], Block(max(e.blocks[t + 1, i], 0))
    return f"action {ACTIONS[action][0]}" + (f", blocked by {block.name.lower()}" if block else "")


def _static(e: EpisodeLog, before: Ints, action: Ints) -> tuple[Ints, Ints]:
    """Return the target of each action (UNKNOWN: off the grid), and the `Block` of the map; shapes of `before`."""
    grid, steps = e.world.grid, np.array([(dr, dc) for _, dr, dc in ACTIONS])
    rows = before // grid.cols + steps[action, 0]
    cols = before % grid.cols + steps[action, 1]
    inside = (rows >= 0) & (rows < grid.rows) & (cols >= 0) & (cols < grid.cols)
    target = np.where(inside, rows * grid.cols + cols, UNKNOWN)
    obstacle = np.where(e.world.map.blocked[target], Block.OBSTACLE, Block.NONE)
    return target, np.where(inside, obstacle, Block.GRID)


def blocks(e: EpisodeLog) -> InvariantResult:
    """Check that a UAV blocks a move exactly when it holds the target.

    A UAV with a lower id holds its cell of the new tick, one with a higher id that of the old tick.
    """
    before, action, block = e.cells[:-1], e.actions[1:], e.blocks[1:]
    target, static = _static(e, before, action)
    free = (before != UNKNOWN) & (e.cells[1:] != UNKNOWN) & (static == Block.NONE) & (action != STAY)
    faults: list[Fault] = []
    for i in range(e.N):
        others = np.concatenate((e.cells[1:, :i], e.cells[:-1, i + 1 :]), axis=1)
        held = (others == target[:, [i]]).any(axis=1)
        unsure = (others == UNKNOWN).any(axis=1)  # a lost UAV may have held it
        by_uav = block[:, i] == Block.UAV
        for bad, what in ((~held & ~unsure & by_uav, "no UAV holds"), (held & ~by_uav, "another UAV holds")):
            wrong = np.flatnonzero(bad & free[:, i])
            logged = "blocked by a UAV" if what == "no UAV holds" else "not blocked"
            faults += [(int(t) + 1, i, f"{logged}, but {what} cell {target[t, i]}") for t in wrong[:1]]
    return first_violation(e, int(free.sum()), faults)


def separation(e: EpisodeLog) -> InvariantResult:
    """Check that no two UAVs are on one cell at one tick."""
    order = np.sort(e.cells, axis=1)
    shared = (np.diff(order, axis=1) == 0) & (order[:, 1:] != UNKNOWN)
    faults: list[Fault] = []
    for t in np.flatnonzero(shared.any(axis=1))[:1].tolist():
        cell = order[t, 1:][shared[t]][0]
        uavs = np.flatnonzero(e.cells[t] == cell).tolist()
        faults.append((t, uavs[0], f"UAVs {uavs} are on cell {cell}"))
    return first_violation(e, int((e.cells != UNKNOWN).sum()), faults)


def sightings(e: EpisodeLog) -> InvariantResult:
    """Check that a UAV sighted the UAVs within its sensing range, tick by tick; in scenario I, all UAVs."""
    faults: list[Fault] = []
    facts = 0
    for i in range(e.N):
        seen = np.array(e.seen[i], np.int64).reshape(2, -1)
        there = _near(e, i)
        facts += there.shape[1]
        if not np.array_equal(seen, there):
            faults += list(_unseen(e, i, seen, there))
    return first_violation(e, facts, faults)


def _near(e: EpisodeLog, i: int) -> Ints:
    """Return ticks and cells of the other UAVs within UAV i's range, by tick and id; shape (2, S)."""
    cols, reach = e.world.grid.cols, e.world.config.team.sensing_range
    dr = e.cells // cols - (e.cells[:, [i]] // cols)
    dc = e.cells % cols - (e.cells[:, [i]] % cols)
    near = (e.world.config.scenario == 1) | (dr * dr + dc * dc <= reach * reach + 1e-9)
    near = near & (e.cells != UNKNOWN) & (e.cells[:, [i]] != UNKNOWN)
    near[:, i] = False
    ticks, uavs = np.nonzero(near)
    return np.stack((ticks, e.cells[ticks, uavs]))


def _unseen(e: EpisodeLog, i: int, seen: Ints, there: Ints) -> Iterator[Fault]:
    """Yield the ticks that differ. A lost UAV may have been sighted where no record holds its cell."""
    for t in np.unique(np.concatenate((seen[0], there[0]))).tolist():
        saw, could = seen[1, seen[0] == t].tolist(), there[1, there[0] == t].tolist()
        gone = int((e.cells[t] == UNKNOWN).sum()) if t <= e.T else 0
        extra = [cell for cell in saw if cell not in could]
        if saw != could and not (len(extra) <= gone and [c for c in saw if c in could] == could):
            yield t, i, f"it reports UAVs on cells {saw}, but the UAVs in its range are on {could}"
