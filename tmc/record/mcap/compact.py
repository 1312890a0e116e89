"""Rewrites the logs of a run for keeping, in large chunks and under their finished names: `overfly log compact`."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

from tmc.record.errors import RecordError
from tmc.record.mcap import rewrite
from tmc.record.mcap.findings import CUT, Findings, Item, Message, Show, unseen
from tmc.record.mcap.recover import finished_name, held
from tmc.record.mcap.salvage import salvage
from tmc.record.reader import run_files

CHUNK = 4 * 1024 * 1024
"""Bytes of a chunk before compression: zstd finds more to share in it, and readers find their place by the indexes."""
_NUMBERS = struct.Struct("<QQIQ")


@dataclass(frozen=True)
class Compacted:
    """One file: its size before and after; `dropped`, the bytes of the torn end that a kill had left."""

    path: Path
    before: int
    after: int
    messages: int
    dropped: int


@dataclass(frozen=True)
class Survey:
    """A file to compact: what was found in it, and digests of its messages and of all else."""

    path: Path
    found: Findings
    digests: tuple[bytes, bytes]


def compact_log(path: Path, show: Show = unseen) -> Compacted:
    """Seal one log, as `compact_run` does."""
    with closing(held(path)):
        return _compact(_survey(path, show), show)


def compact_run(folder: Path, show: Show = unseen) -> list[Compacted]:
    """Seal all logs of a run. RecordError, and nothing is changed, when one is still written or is damaged."""
    paths = list(run_files(folder).values())
    with ExitStack() as stack:
        for path in paths:
            stack.enter_context(closing(held(path)))
        return [_compact(survey, show) for survey in [_survey(path, show) for path in paths]]


def _survey(path: Path, show: Show) -> Survey:
    """All there is in a file; RecordError when more is wrong with it than the end that a kill tears off."""
    found, items = salvage(path, "reading", show)
    digests = _digests(items)
    torn = len(found.lost) == 1 and found.lost[0].why == CUT and path.suffix != ".mcap"
    if not (found.whole or torn) or found.notes:
        what = "; ".join([*map(str, found.lost), *found.notes]) or "messages are missing"
        raise RecordError(f"{path} is damaged ({what}): run `overfly log recover` on it before it is compacted")
    return Survey(path, found, digests)


def _compact(old: Survey, show: Show) -> Compacted:
    path, target = old.path, finished_name(old.path)
    before = path.stat().st_size

    def check(new: Path) -> None:
        if _digests(salvage(new, "comparing", show)[1]) != old.digests:
            raise RecordError(f"{path} could not be compacted: the copy is not the same; the log is as it was")

    after = rewrite.write(target, CHUNK, old.found.profile, salvage(path, "sealing", show)[1], check)
    if target != path:
        path.unlink()
    return Compacted(target, before, after, old.found.messages, sum(lost.bytes for lost in old.found.lost))


def _digests(items: Iterable[Item]) -> tuple[bytes, bytes]:
    """Of the messages in their order, with all that describes them; and of attachments and metadata in theirs."""
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
    """Of channel and schema, without their numbers in the file."""
    schema = (m.schema.name, m.schema.encoding, m.schema.data) if m.schema else ()
    channel = (m.channel.topic, m.channel.message_encoding, m.channel.metadata)
    return blake2b(repr((channel, schema)).encode()).digest()
