"""Replays a journal and checks every invariant of a flight: `overfly log check`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tmc.analysis.invariants import flight, map, reward
from tmc.analysis.invariants.episode_log import EpisodeLog, Gathering
from tmc.analysis.invariants.recompute import Reference, truth
from tmc.analysis.invariants.result import InvariantResult, Violation
from tmc.analysis.invariants.state import STATE, states
from tmc.analysis.run_config import world_of
from tmc.record.errors import RecordError
from tmc.record.reader import Log, LogMessage
from tmc.record.run_folder import run_files

Law = Callable[[EpisodeLog, Reference], InvariantResult]


def _of_records(law: Callable[[EpisodeLog], InvariantResult]) -> Law:
    return lambda e, _truth: law(e)


INVARIANTS: tuple[tuple[str, str, Law], ...] = (
    ("episodes", "begun and ended once, in order, nothing anomalies in them", _of_records(flight.episodes)),
    ("starts", "cells at tick 0 with the draws of the seed", _of_records(flight.starts)),
    ("sequence", "numbers of a UAV's records, without gap or repeat", _of_records(flight.sequence)),
    ("ticks", "ticks of a UAV's records, without gap or repeat", _of_records(flight.ticks)),
    ("cadence", "ends of records with the ticks that they are due at", _of_records(flight.cadence)),
    ("lost", "who was lost with whose records end early", _of_records(flight.lost)),
    ("moves", "cells with actions, blocks and the map", _of_records(flight.moves)),
    ("blocks", "moves blocked by UAVs with those that hold the target", _of_records(flight.blocks)),
    ("separation", "no two UAVs on one cell", _of_records(flight.separation)),
    ("sightings", "who was seen with who was in range", _of_records(flight.sightings)),
    ("exchanges", "ticks and UAVs of exchanges with the records due", map.exchanges),
    ("versions", "map versions one an exchange, and those flown by", map.versions),
    ("maps", "maps handed out with the records up to their tick", map.maps),
    ("believed", "uncertainty of these maps with their visits", map.believed),
    ("events", "events with the draws of the seed (scenario I)", map.events),
    ("uncertainty", "the true map's sum by tick with all visits", map.series),
    ("accounting", "sums by cell with what each visit took (scenario II)", map.accounting),
    ("own rewards", "rewards in records with the UAV's own map", reward.own),
    ("team rewards", "mean rewards by tick with the true map", reward.team),
    ("sums", "an episode's end with its ticks", reward.sums),
)
"""Name, what is compared, and the law."""
FILE = "file"


@dataclass
class Row:
    """An invariant over all episodes: facts compared, and the first violation."""

    name: str
    compared: str
    facts: int = 0
    violation: Violation | None = None

    def add(self, found: InvariantResult) -> None:
        self.facts += found.facts
        self.violation = self.violation or found.violation


@dataclass
class Result:
    """What came of a journal; `note`: what is worth saying and breaks nothing."""

    path: Path
    rows: list[Row]
    episodes: int = 0
    unfinished: int = 0
    note: str = ""

    @property
    def good(self) -> bool:
        """Every invariant holds."""
        return all(row.violation is None for row in self.rows)

    def table(self) -> Iterator[str]:
        """One line an invariant."""
        wide = max(len(row.compared) for row in self.rows)
        yield f"{'invariant':<13} {'what is compared':<{wide}} {'facts':>11}"
        for row in self.rows:
            word = "-" if not row.facts else "ok"
            said = f"VIOLATED: {row.violation}" if row.violation else word
            yield f"{row.name:<13} {row.compared:<{wide}} {row.facts:>11,}  {said}"

    def summary(self) -> str:
        """All of it in one sentence."""
        broken, facts = sum(row.violation is not None for row in self.rows), sum(row.facts for row in self.rows)
        conclusion = f"{broken} of {len(self.rows)} invariants are violated" if broken else "all invariants hold"
        open_ = f" ({self.unfinished} not finished)" if self.unfinished else ""
        count = f"{self.episodes} episode{'s' * (self.episodes != 1)}"
        return f"{self.path}: {count}{open_}, {facts:,} facts, {conclusion}{self.note}"


def check(folder: Path, show: Callable[[str, float], None] = lambda *_: None) -> Result:
    """Check the journal of a run. `show` is told which episode was checked, and which share of the mission that is.

    RecordError where there is none, or where its config cannot be used.
    """
    files = run_files(folder)
    if "tmc" not in files:
        raise RecordError(f"{folder} holds no tmc.mcap: give the folder of the run on the host where the TMC ran")
    path = files["tmc"]
    world, notes = world_of(folder, path)
    result = Result(path, [Row(FILE, "CRCs and numbers of messages to the end of the file")])
    rows = [Row(name, compared) for name, compared, _ in INVARIANTS]
    result.rows += [*rows, state := Row(*STATE)]
    log = Log(path)
    for e in Gathering(world).episodes(_intact(log, result.rows[0])):
        reckoned = truth(e)
        for row, (_, _, law) in zip(rows, INVARIANTS, strict=True):
            row.add(law(e, reckoned))
        result.episodes += 1
        result.unfinished += not e.ended
        show(f"checked episode {e.number}", e.number / world.config.training.episodes)
    state.add(states(world, log, show))
    _check_file(log, result)
    result.note += "".join(f"; {note}" for note in notes)
    if not result.episodes:
        rows[0].violation = Violation(None, None, None, "there is none: nothing was flown, or nothing of it is left")
    return result


def _intact(log: Log, row: Row) -> Iterator[LogMessage]:
    """All messages of a journal; one that does not decode ends it."""
    try:
        for entry in log.entries():
            row.facts += 1
            yield entry
    except RecordError as error:
        row.violation = Violation(None, None, None, str(error))


def _check_file(log: Log, result: Result) -> None:
    """Damage, and what is known to be lost; a journal that a kill cut off, or that still grows, is good as it is."""
    left = log.still_open
    lost = log.lost.get("lost")
    faults = [log.damage] if log.damage and not left else []
    faults += [f"lost: {lost}"] if lost else []
    if faults and result.rows[0].violation is None:
        result.rows[0].violation = Violation(None, None, None, "; ".join(faults))
    result.note = "; the file was not closed" if left else ""
