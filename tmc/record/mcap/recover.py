"""Make an intact, finished log of a file that was cut or damaged: `overfly log recover`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import IO

from mcap.records import Metadata

from tmc.kernel.config import JournalConfig
from tmc.record import disk
from tmc.record.errors import NoLogError, RecordError
from tmc.record.mcap import rewrite
from tmc.record.mcap.findings import Findings, Item, Show, unseen
from tmc.record.mcap.parser import RECOVERED
from tmc.record.mcap.salvage import salvage
from tmc.record.run_folder import finished_name


@dataclass(frozen=True)
class Recovery:
    """The result for one file. `out` is None where there was nothing to do."""

    path: Path
    out: Path | None
    found: Findings

    @property
    def clean(self) -> bool:
        """True when nothing that the file held is lost."""
        return self.found.whole

    def lines(self) -> Iterator[str]:
        """Yield the report for the user."""
        found = self.found
        if self.out is None:
            yield f"{self.path}: intact and finished, {found.messages:,} messages; there is nothing to do"
            return
        yield f"{self.path}: {found.messages:,} messages are intact; they are in {self.out}"
        yield from (f"  {note}" for note in found.notes)
        yield from (f"  lost {part}" for part in losses(found))
        if self.clean:
            yield "  nothing is lost" + ("" if found.finished else "; it was not closed")


def losses(found: Findings) -> Iterator[str]:
    """Yield what is lost, one phrase each."""
    yield from map(str, found.lost)
    if found.missing:
        yield f"{found.missing:,} messages, by the gaps in the numbers of the others"
    if found.nameless:
        yield f"{found.nameless:,} intact messages whose topics were described in what is lost"


def recovered_name(path: Path) -> Path:
    """Return `X.recovered.mcap` for X.mcap and for X.mcap.active."""
    return path.with_name(path.name.partition(".mcap")[0] + ".recovered.mcap")


def recover(path: Path, out: Path | None = None, *, in_place: bool = False, show: Show = unseen) -> Recovery:
    """Write what is intact in `path` to `out`, by default beside it; with `in_place`, replace `path`.

    In place, a file from which something is lost is kept as `*.damaged-1`. RecordError when nothing can be read, when
    the result cannot be written, or when a process still writes the file.
    """
    with closing(locked(path)):
        found = survey(path, show)
        if found.finished and found.whole and not found.notes:
            return Recovery(path, None, found)
        target = finished_name(path) if in_place else out or recovered_name(path)
        if os.path.lexists(target) and not (in_place and target == path):
            fix = "remove the one that you do not want" if in_place else "choose another --out, or remove it"
            raise RecordError(f"{target} exists already: {fix}")

        def keep_original(_new: Path) -> None:
            if in_place and not found.whole:
                keep_damaged(path)

        items = chain(_mark(found), salvage(path, "writing what is intact in", show)[1])
        rewrite.write(target, JournalConfig().chunk, found.profile, items, keep_original)
        if in_place and target != path:
            path.unlink()
    return Recovery(path, target, found)


def locked(path: Path) -> IO[bytes]:
    """Open a file and lock it against writers until it is closed. NoLogError when it cannot be read."""
    try:
        file: IO[bytes] = disk.open_locked(path, "rb")
    except OSError as error:
        raise NoLogError(f"{path} cannot be read ({error.strerror}): check the path of the log") from None
    return file


def survey(path: Path, show: Show) -> Findings:
    """Read all of a file and return the findings; NoLogError when nothing in it is intact."""
    found, items = salvage(path, "reading", show)
    intact = sum(1 for _ in items)
    if not intact and not (found.finished and found.whole):
        raise NoLogError(
            f"{path} holds nothing that is intact: it is not an MCAP file, or it is damaged from begin to end"
        )
    return found


def keep_damaged(path: Path) -> Path:
    """Keep a damaged file under another name and return that: it may hold more than Overfly can read."""
    names = (path.with_name(f"{path.name}.damaged-{n}") for n in count(1))
    kept = next(name for name in names if not name.exists())
    kept.hardlink_to(path)
    return kept


def _mark(found: Findings) -> Iterator[Item]:
    """Yield metadata on what is lost, for the readers; nothing where nothing is lost."""
    if not found.whole:
        facts = {"lost": "; ".join(losses(found)), "messages_missing": str(found.missing)}
        yield Metadata(name=RECOVERED, metadata=facts)
