"""Check every invariant of a flight against the TMC's log: `overfly log check`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tmc.analysis.invariants import flight, map, reward
from tmc.analysis.invariants.episode_log import EpisodeCollector, EpisodeLog
from tmc.analysis.invariants.recompute import Reference, truth
from tmc.analysis.invariants.result import InvariantResult, Violation
from tmc.analysis.invariants.state import STATE, states
from tmc.analysis.run_config import world_of
from tmc.record.errors import RecordError
from tmc.record.reader import Log, LogMessage
from tmc.record.run_folder import tmc_log

Invariant = Callable[[EpisodeLog, Reference], InvariantResult]


def _of_records(check: Callable[[EpisodeLog], InvariantResult]) -> Invariant:
    return lambda e, _truth: check(e)


INVARIANTS: tuple[tuple[str, str, Invariant], ...] = (
    ("episodes", "begun and ended once, in order, without anomalies", _of_records(flight.episodes)),
    ("starts", "cells at tick 0 with the draws of the seed", _of_records(flight.starts)),
    ("sequence", "numbers of a UAV's records, without gap or repeat", _of_records(flight.sequence)),
    ("ticks", "ticks of a UAV's records, without gap or repeat", _of_records(flight.ticks)),
    ("cadence", "ends of records with the ticks at which they are due", _of_records(flight.cadence)),
    ("lost", "lost UAVs with the UAVs whose records end early", _of_records(flight.lost)),
    ("moves", "cells with actions, blocks and the map", _of_records(flight.moves)),
    ("blocks", "moves blocked by UAVs with those that hold the target", _of_records(flight.blocks)),
    ("separation", "no two UAVs on one cell", _of_records(flight.separation)),
    ("sightings", "sighted UAVs with the UAVs in range", _of_records(flight.sightings)),
    ("exchanges", "ticks and UAVs of exchanges with the records due", map.exchanges),
    ("versions", "one map version per exchange, and versions in records", map.versions),
    ("maps", "maps handed out with the records up to their tick", map.maps),
    ("believed", "uncertainty of these maps with their visits", map.believed),
    ("events", "events with the draws of the seed (scenario I)", map.events),
    ("uncertainty", "the true map's sum by tick with all visits", map.series),
    ("accounting", "sums per cell with what each visit took (scenario II)", map.accounting),
    ("own rewards", "rewards in records with the UAV's own map", reward.own),
    ("team rewards", "mean rewards by tick with the true map", reward.team),
    ("sums", "an episode's end with its ticks", reward.sums),
)
"""Name, what is compared, and the function that compares it."""
FILE = "file"


@dataclass
class Row:
    """The result of an invariant over all episodes: number of facts compared, and the first violation."""

    name: str
    compared: str
    facts: int = 0
    violation: Violation | None = None

    def add(self, found: InvariantResult) -> None:
        """Add the result for one episode."""
        self.facts += found.facts
        self.violation = self.violation or found.violation


@dataclass
class Result:
    """The result for a journal. `note`: a remark that violates nothing."""

    path: Path
    rows: list[Row]
    episodes: int = 0
    unfinished: int = 0
    note: str = ""

    @property
    def good(self) -> bool:
        """True when every invariant holds."""
        return all(row.violation is None for row in self.rows)

    def table(self) -> Iterator[str]:
        """Yield one line per invariant."""
        wide = max(len(row.compared) for row in self.rows)
        yield f"{'invariant':<13} {'what is compared':<{wide}} {'facts':>11}"
        for row in self.rows:
            word = "-" if not row.facts else "ok"
            outcome = f"VIOLATED: {row.violation}" if row.violation else word
            yield f"{row.name:<13} {row.compared:<{wide}} {row.facts:>11,}  {outcome}"

    def summary(self) -> str:
        """Return the result in one sentence."""
        broken, facts = sum(row.violation is not None for row in self.rows), sum(row.facts for row in self.rows)
        conclusion = f"{broken} of {len(self.rows)} invariants are violated" if broken else "all invariants hold"
        open_ = f" ({self.unfinished} not finished)" if self.unfinished else ""
        count = f"{self.episodes} episode{'s' * (self.episodes != 1)}"
        return f"{self.path}: {count}{open_}, {facts:,} facts, {conclusion}{self.note}"


def check(folder: Path, show: Callable[[str, float], None] = lambda *_: None) -> Result:
    """Check the journal of a run.

    `show` gets words on the work, and the share of the mission that is checked, 0 to 1. RecordError when there is no
    journal, or its config cannot be used.
    """
    path = tmc_log(folder)
    world, notes = world_of(folder, path)
    result = Result(path, [Row(FILE, "CRCs and numbers of messages to the end of the file")])
    rows = [Row(name, compared) for name, compared, _ in INVARIANTS]
    result.rows += [*rows, state := Row(*STATE)]
    log = Log(path)
    for e in EpisodeCollector(world).episodes(_intact(log, result.rows[0])):
        reference = truth(e)
        for row, (_, _, invariant) in zip(rows, INVARIANTS, strict=True):
            row.add(invariant(e, reference))
        result.episodes += 1
        result.unfinished += not e.ended
        show(f"checked episode {e.number}", e.number / world.config.training.episodes)
    state.add(states(world, log, show))
    _check_file(log, result)
    result.note += "".join(f"; {note}" for note in notes)
    if not result.episodes:
        rows[0].violation = Violation(
            None, None, None, "there is no episode: nothing was flown, or its records are lost"
        )
    return result


def _intact(log: Log, row: Row) -> Iterator[LogMessage]:
    """Yield the messages of a journal up to the first that cannot be decoded."""
    try:
        for entry in log.entries():
            row.facts += 1
            yield entry
    except RecordError as error:
        row.violation = Violation(None, None, None, str(error))


def _check_file(log: Log, result: Result) -> None:
    """Note damage and known losses. A journal that a kill cut off, or that still grows, is not damaged."""
    still_open = log.still_open
    lost = log.lost.get("lost")
    faults = [log.damage] if log.damage and not still_open else []
    faults += [f"lost: {lost}"] if lost else []
    if faults and result.rows[0].violation is None:
        result.rows[0].violation = Violation(None, None, None, "; ".join(faults))
    result.note = "; the file was not closed" if still_open else ""
