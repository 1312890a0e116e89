"""Invariants of what the TMC computed from the records: exchanges, maps, events, uncertainty, and its balance."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tmc.analysis.invariants.episode_log import UNKNOWN, EpisodeLog
from tmc.analysis.invariants.flight import Fault
from tmc.analysis.invariants.recompute import Reference, accounts, maps_handed_out, rates_of, start_factor, uncertainty
from tmc.analysis.invariants.result import InvariantResult, close, first_violation

SUM_TOLERANCE = 1e-6
"""Largest difference between a sum in the journal and the recomputed one, relative for values above 1."""


def exchanges(e: EpisodeLog, _truth: Reference) -> InvariantResult:
    """Check that at each tick at which UAVs are due, one exchange answers these, once their records are in."""
    logged = [s.tick for s in e.syncs]
    faults: list[Fault] = [(b, None, f"an exchange at tick {b} follows one at {a}")
                           for a, b in pairwise(logged) if b <= a]  # fmt: skip
    for s in e.syncs:
        due = [i for i in range(e.N) if i not in s.lost and e.world.config.due(i, s.tick)]
        if s.uavs != due:
            faults.append((s.tick, None, f"UAVs {s.uavs} are answered, {due} are due"))
        faults += [(s.tick, i, "its record is not waited for") for i in due if s.reported[i] < s.tick]
    faults += [(t, None, "no exchange is logged, but UAVs were due") for t in _needed(e) - set(logged)]
    return first_violation(e, len(e.syncs), faults)


def _needed(e: EpisodeLog) -> set[int]:
    """Return the ticks of exchanges that must be in the log: a UAV flew on from there, or the episode is over."""
    lost, config = {i for i, *_ in e.lost}, e.world.config
    upto = [e.T + 1 if e.ended and i not in lost else max(e.reported[i], 0) for i in range(e.N)]
    return {t for i in range(e.N) for t in range(upto[i]) if config.due(i, t)}


def versions(e: EpisodeLog, _truth: Reference) -> InvariantResult:
    """Check that map versions go up by one per exchange, over all episodes, and that records name the version given."""
    version = e.before.version
    faults: list[Fault] = []
    for s in e.syncs:
        version += 1
        if s.version != version:
            faults.append((s.tick, None, f"map {s.version} follows where {version} is next"))
        version = s.version
    faults += [(r.tick, r.uav, f"its record names map {r.version}, but it was given {r.given}")
               for r in e.records if r.version != r.given]  # fmt: skip
    return first_violation(e, len(e.syncs) + len(e.records), faults)


def maps(e: EpisodeLog, _truth: Reference) -> InvariantResult:
    """Check that each exchange hands out the latest visit of each cell, of all records up to its tick (scenario II)."""
    if e.world.config.scenario == 1:
        return first_violation(e, 0, [(s.tick, None, "a map of visits is logged in scenario I") for s in e.syncs
                             if s.last_visit is not None])  # fmt: skip
    faults: list[Fault] = []
    for s, expected in zip(e.syncs, maps_handed_out(e), strict=True):
        if s.last_visit is None:
            if e.ended or s is not e.syncs[-1]:
                faults.append((s.tick, None, "the map of the exchange is missing"))
            continue
        for k in np.flatnonzero(s.last_visit != expected)[:1].tolist():
            faults.append((s.tick, None, f"cell {k} was visited at tick {expected[k]}, not {s.last_visit[k]}"))
    return first_violation(e, sum(s.last_visit is not None for s in e.syncs) * e.world.grid.size, faults)


def believed(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """Check the uncertainty of the map of each exchange, summed over cells; in scenario I, the active events."""
    rates, start = rates_of(e.world), start_factor(e)
    if e.world.config.scenario == 1:
        values = [float(truth.active[s.tick].sum()) if s.tick <= e.T else np.nan for s in e.syncs]
    else:
        values = [float(uncertainty(rates, start, m[rates.cells], s.tick).sum())
                  for s, m in zip(e.syncs, maps_handed_out(e), strict=True)]  # fmt: skip
    wrong = ((s, v) for s, v in zip(e.syncs, values, strict=True) if not close(s.believed, v, SUM_TOLERANCE))
    faults = ((s.tick, None, f"{s.believed:.9g} is logged, the map gives {v:.9g}") for s, v in wrong)
    return first_violation(e, len(e.syncs), faults)


def events(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """Check that new events are the draws of the seed where no event was active (scenario I; none in II)."""
    upto = e.last_final()
    if not e.ended and e.metrics and all(t < e.metrics[-1].first for t, _ in e.events):
        upto = e.metrics[-1].first - 1  # the journal may end before the last ticks' events
    drawn = {(t, k) for t, cells in enumerate(truth.events[: upto + 1]) for k in cells}
    logged = set(e.events)
    faults: list[Fault] = [(t, None, f"an event in cell {k} was not drawn") for t, k in logged - drawn if t <= upto]
    faults += [(t, None, f"an event in cell {k} was drawn, and is not logged") for t, k in drawn - logged]
    if len(logged) < len(e.events):
        faults.append((None, None, f"{len(e.events) - len(logged)} events are logged twice"))
    return first_violation(e, len(drawn), faults)


def series(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """Check the uncertainty by tick, summed over cells, against the visits; each tick is logged once, in order."""
    faults, following, facts = list[Fault](), 0, 0
    for m in e.metrics:
        if m.first != following or len(m.reward) != len(m.uncertainty):
            faults.append((m.first, None, f"metrics begin at tick {m.first}, {following} is next"))
        following = m.first + len(m.uncertainty)
        for t, value in enumerate(m.uncertainty, m.first):
            facts += 1
            if t > e.T or not close(value, truth.uncertainty[t], SUM_TOLERANCE):
                made = truth.uncertainty[t] if t <= e.T else np.nan
                faults.append((t, None, f"{value:.9g} is logged, the visits give {made:.9g}"))
        flown = int((e.cells[1:following] != UNKNOWN).sum())
        if e.begins and m.steps != e.begins[0].steps + flown:
            faults.append((m.first, None, f"{m.steps} steps are logged, {e.begins[0].steps + flown} were flown"))
    missing = following <= e.T and e.ended
    faults += [(following, None, "the uncertainty from here on is missing")] if missing else []
    return first_violation(e, facts, faults)


def accounting(e: EpisodeLog, truth: Reference) -> InvariantResult:
    """Check the balance of the uncertainty in scenario II, per cell and in total.

    The uncertainty of a cell, summed over ticks, is that without visits less what each visit removed. The total over
    cells is that of the log.
    """
    if e.world.config.scenario == 1 or not e.ended:
        return InvariantResult(0)
    left, right = accounts(e, truth.found)
    cells = rates_of(e.world).cells
    faults: list[Fault] = [(None, None, f"cell {cells[k]} adds up to {left[k]:.9g}, by its visits to {right[k]:.9g}")
                           for k in np.flatnonzero(np.abs(left - right) > SUM_TOLERANCE)[:1]]  # fmt: skip
    logged = {t: v for m in e.metrics for t, v in enumerate(m.uncertainty, m.first) if t}
    total = sum(logged.values())
    if not abs(total - right.sum()) <= SUM_TOLERANCE + 1e-12 * abs(total):
        faults.append((None, None, f"the log adds up to {total:.9g}, by its visits to {right.sum():.9g}"))
    visits = int((e.cells[1:] != UNKNOWN).sum())
    return first_violation(e, cells.size + visits, faults)
