"""Rewrite the logs of a run in large chunks and under their finished names: `overfly log compact`."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

from tmc.record.errors import RecordError
from tmc.record.mcap import rewrite
from tmc.record.mcap.findings import Findings, Item, Show, unseen
from tmc.record.mcap.parser import CUT, Message
from tmc.record.mcap.recover import locked
from tmc.record.mcap.salvage import salvage
from tmc.record.run_folder import finished_name, run_files

CHUNK_BYTES = 4 * 1024 * 1024
"""Size of a chunk before compression. zstd compresses large chunks better; readers find messages by the indexes."""
_NUMBERS = struct.Struct("<QQIQ")


@dataclass(frozen=True)
class Compacted:
    """One file: its size before and after, bytes; `dropped`: bytes of the incomplete end that a kill left."""

    path: Path
    before: int
    after: int
    messages: int
    dropped: int


@dataclass(frozen=True)
class Survey:
    """A file to compact: what was found in it; digests of its messages and of everything else."""

    path: Path
    found: Findings
    digests: tuple[bytes, bytes]


def compact_log(path: Path, show: Show = unseen) -> Compacted:
    """Compact one log, as `compact_run` does."""
    with closing(locked(path)):
        return _compact(_survey(path, show), show)


def compact_run(folder: Path, show: Show = unseen) -> list[Compacted]:
    """Compact all logs of a run. RecordError, and nothing is changed, when one is still written or is damaged."""
    paths = list(run_files(folder).values())
    with ExitStack() as stack:
        for path in paths:
            stack.enter_context(closing(locked(path)))
        return [_compact(survey, show) for survey in [_survey(path, show) for path in paths]]


def _survey(path: Path, show: Show) -> Survey:
    """Read all of a file; RecordError when more is wrong with it than the incomplete end that a kill leaves."""
    found, items = salvage(path, "reading", show)
    digests = _digests(items)
    only_cut = len(found.lost) == 1 and found.lost[0].why == CUT and path.suffix != ".mcap"
    if not (found.whole or only_cut) or found.notes:
        what = "; ".join([*map(str, found.lost), *found.notes]) or "messages are missing"
        raise RecordError(f"{path} is damaged ({what}): run `overfly log recover` on it before it is compacted")
    return Survey(path, found, digests)


def _compact(old: Survey, show: Show) -> Compacted:
    path, target = old.path, finished_name(old.path)
    before = path.stat().st_size

    def check(new: Path) -> None:
        if _digests(salvage(new, "comparing", show)[1]) != old.digests:
            raise RecordError(f"{path} could not be compacted: the copy differs from it; the log is unchanged")

    after = rewrite.write(target, CHUNK_BYTES, old.found.profile, salvage(path, "compacting", show)[1], check)
    if target != path:
        path.unlink()
    return Compacted(target, before, after, old.found.messages, sum(span.bytes for span in old.found.lost))


def _digests(items: Iterable[Item]) -> tuple[bytes, bytes]:
    """Return the digests of the messages with their descriptions, and of attachments and metadata, each in order."""
    messages, rest, described = blake2b(), blake2b(), dict[int, bytes]()
    for item in items:
        if not isinstance(item, list):
            rest.update(repr(item).encode())
            continue
        for m in item:
            if m.channel.id not in described:
                described[m.channel.id] = _description(m)
            messages.update(described[m.channel.id])
            messages.update(_NUMBERS.pack(m.log_time, m.publish_time, m.sequence, len(m.data)))
            messages.update(m.data)
    return messages.digest(), rest.digest()


def _description(m: Message) -> bytes:
    """Return a digest of channel and schema, without their numbers in the file."""
    schema = (m.definition.name, m.definition.encoding, m.definition.data) if m.definition else ()
    channel = (m.channel.topic, m.channel.message_encoding, m.channel.metadata)
    return blake2b(repr((channel, schema)).encode()).digest()
