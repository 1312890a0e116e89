"""Goes on with the log of an earlier life: copies what is sound in it to the file of the new one."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from tmc.record.frames import RECOVERED
from tmc.record.reader import Log

if TYPE_CHECKING:
    from tmc.record.writer import LogWriter


def copy(old: Path, new: LogWriter) -> None:
    """Copy all sound messages and attachments of `old`, numbers and times kept.

    The torn end that a kill leaves is dropped. Where anything else is wrong, the old file is kept as `*.damaged-1`,
    since there may be sound chunks behind the damage.
    """
    if old.stat().st_size == 0:
        return
    log = Log(old)
    if log.lost:
        new.note(RECOVERED, log.lost)
    for note in log.notes():
        if note.name != RECOVERED:
            new.note(note.name, note.metadata)
    for attachment in log.attachments():
        new.attach(attachment.name, attachment.media_type, attachment.data)
    for raw in log.raw():
        new.put(raw.topic, raw.data, raw.log_time, raw.publish_time, raw.sequence)
    if log.damage is not None and not log.still_open:
        names = (old.with_name(f"{old.name}.damaged-{n}") for n in count(1))
        kept = next(name for name in names if not name.exists())
        kept.hardlink_to(old)
        new.log("error", f"{log.damage}: this life goes on from before that; the file is kept as {kept.name}")
