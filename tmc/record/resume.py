"""Goes on with the log of an earlier incarnation: copies what is intact in it to the file of the new one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mcap.records import Attachment

from tmc.record.mcap.parser import RECOVERED
from tmc.record.mcap.recover import keep
from tmc.record.reader import Log

if TYPE_CHECKING:
    from tmc.record.writer import LogWriter


def copy(old: Path, new: LogWriter) -> None:
    """Copy all intact messages and attachments of `old`, numbers and times kept.

    Metadata too. The torn end that a kill leaves is dropped. Where anything else is wrong, the old file is kept as
    `*.damaged-1`, since there may be intact chunks behind the damage, and the new one says so.
    """
    if old.stat().st_size == 0:
        return
    log = Log(old)
    if log.lost:
        new.note(RECOVERED, log.lost)
    for extra in log.extras():
        if isinstance(extra, Attachment):
            new.attach(extra.name, extra.media_type, extra.data)
        elif extra.name != RECOVERED:
            new.note(extra.name, extra.metadata)
    for raw in log.raw():
        new.put(raw.topic, raw.data, raw.log_time, raw.publish_time, raw.sequence)
    if log.damage is not None and not log.still_open:
        new.log(
            "error", f"{log.damage}: this incarnation goes on from before that; the file is kept as {keep(old).name}"
        )
