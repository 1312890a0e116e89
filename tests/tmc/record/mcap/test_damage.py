"""Logs cut and damaged anywhere: nothing is invented, nothing that was flushed before the damage is lost; nor after
`recover`, which also finds what is intact behind it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from tmc.kernel.config import JournalConfig
from tmc.record import schemas
from tmc.record.errors import RecordError
from tmc.record.mcap.recover import recover, recovered_name
from tmc.record.reader import Log
from tmc.record.writer import LogWriter

ROUNDS = 12
Message = tuple[str, int, int, bytes]


class Whole:
    """A file as it was written. `chunks`: (begin, end of chunk and indexes, messages so far, messages with it).

    No dataclass: hypothesis would print all of it.
    """

    def __init__(self, path: Path, chunks: list[tuple[int, int, int, int]]) -> None:
        self.name, self.data, self.messages, self.chunks = path.name, path.read_bytes(), messages_of(path), chunks


def make(folder: Path, *, close: bool) -> Whole:
    path, chunks, clock = folder / "tmc.mcap", list[tuple[int, int, int, int]](), iter(range(10**9))
    log = LogWriter(path, "tmc", JournalConfig(flush_interval=60.0), {"seed": "1"}, clock=lambda: next(clock))
    log.attach("config.json", "application/json", b'{"a": 1}')
    written = 0
    for n in range(ROUNDS):
        log.flush()
        begin = log.active.stat().st_size
        log.log("info", f"round {n}")
        for tick in range(5):
            log.write("/tmc/sync", schemas.Sync(episode=1, tick=5 * n + tick, uavs=range(tick), believed=n / 3))
        log.flush()
        chunks.append((begin, log.active.stat().st_size, written, written + 6))
        written += 6
        if n == 5:
            log.attach("map.csv", "text/csv", b"0,1,2")
    if close:
        log.close()
    else:
        log._give_up()
    return Whole(path if close else log.active, chunks)


def messages_of(path: Path) -> list[Message]:
    return [(m.topic, m.log_time, m.sequence, m.data) for m in Log(path).raw()]


@pytest.fixture(scope="module")
def wholes(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Whole]:
    return {close: make(tmp_path_factory.mktemp("whole"), close=close) for close in (True, False)}


# What can happen to a file: each takes its bytes and says where the damage begins and, where nothing moves, ends.

Damaged = tuple[bytes, int, int | None]


def cut(data: bytes, at: int, _: bytes) -> Damaged:
    return data[:at], at, len(data)


def flip(data: bytes, at: int, new: bytes) -> Damaged:
    return data[:at] + bytes([data[at] ^ (new[0] or 1)]) + data[at + 1 :], at, at + 1


def overwrite(data: bytes, at: int, new: bytes) -> Damaged:
    return (data[:at] + new + data[at + len(new) :])[: len(data)], at, at + len(new)


def zeros(data: bytes, at: int, new: bytes) -> Damaged:
    """As a disk leaves a block that it never wrote."""
    return overwrite(data, at, bytes(8 * len(new)))


def insert(data: bytes, at: int, new: bytes) -> Damaged:
    return data[:at] + new + data[at:], at, None


def remove(data: bytes, at: int, new: bytes) -> Damaged:
    return data[:at] + data[at + 3 * len(new) :], at, None


def repeat(data: bytes, at: int, new: bytes) -> Damaged:
    """A stretch that stands elsewhere in the file comes twice."""
    begin = int.from_bytes(new[:3], "little") % len(data)
    return data[:at] + data[begin : begin + 40 * len(new)] + data[at:], at, None


HARM = [cut, flip, overwrite, zeros, insert, remove, repeat]
PROPERTY = settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
harms = st.lists(
    st.tuples(st.sampled_from(HARM), st.integers(0, 10**6), st.binary(min_size=1, max_size=60)), min_size=1, max_size=3
)


def harm(whole: Whole, what: list[Any]) -> tuple[bytes, int, list[tuple[int, int]] | None]:
    """The bytes after all of it; where the first damage is; and all stretches, None where bytes moved."""
    data, first, stretches = whole.data, len(whole.data), list[tuple[int, int]]()
    moved = False
    for change, at, new in what:
        if not data:
            break
        data, begin, end = change(data, at % len(data), new)
        first, moved = min(first, begin), moved or end is None
        stretches.append((begin, end or 0))
    return data, first, None if moved else stretches


def in_order(found: list[Message], written: list[Message]) -> bool:
    """All that is found was written, in this order."""
    rest = iter(written)
    return all(message in rest for message in found)


def flushed_before(whole: Whole, at: int) -> int:
    return max((upto for _, end, _, upto in whole.chunks if end <= at), default=0)


@PROPERTY
@given(close=st.booleans(), what=harms)
@example(close=True, what=[(cut, 30, b"x")])
@example(close=False, what=[(zeros, 200, bytes(60))])
def test_the_reader_gives_a_beginning_of_what_was_written(
    wholes: dict[bool, Whole], tmp_path: Path, close: bool, what: list[Any]
) -> None:
    whole = wholes[close]
    data, first, _ = harm(whole, what)
    path = tmp_path / whole.name
    path.write_bytes(data)
    try:
        found = messages_of(path)
    except RecordError:
        assert first < 8 or not data
        return
    assert found == whole.messages[: len(found)]
    assert len(found) >= flushed_before(whole, first)
    if close and data != whole.data:
        assert Log(path).damage is not None


@PROPERTY
@given(close=st.booleans(), what=harms)
@example(close=True, what=[(overwrite, 0, b"garbage here")])
@example(close=False, what=[(overwrite, 0, b"gar")])
@example(close=True, what=[(zeros, 300, bytes(60)), (flip, 900, b"x")])
@example(close=True, what=[(zeros, 243, b"abc")])
def test_recovery_invents_nothing_and_finds_all_that_is_sound(
    wholes: dict[bool, Whole], tmp_path: Path, close: bool, what: list[Any]
) -> None:
    whole = wholes[close]
    data, first, stretches = harm(whole, what)
    path = tmp_path / whole.name
    path.write_bytes(data)
    out = recovered_name(path)
    out.unlink(missing_ok=True)
    try:
        result = recover(path)
    except RecordError as error:
        assert "holds nothing that is intact" in str(error) or "is empty" in str(error)
        assert not flushed_before(whole, first) and not out.exists()
        return
    assert path.read_bytes() == data
    if result.out is None:
        assert data == whole.data
        return
    found = messages_of(out)
    assert in_order(found, whole.messages)
    assert found[: flushed_before(whole, first)] == whole.messages[: flushed_before(whole, first)]
    assert found == whole.messages or not result.clean
    log = Log(out)
    assert log.finished and log.damage is None and bool(log.lost) != result.clean
    assert {a.data for a in log.attachments()} <= {b'{"a": 1}', b"0,1,2"}
    with out.open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == len(found)
    if stretches is not None:
        assert set(found) >= set(untouched(whole, stretches))
    assert recover(out).out is None


def untouched(whole: Whole, stretches: list[tuple[int, int]]) -> Iterator[Message]:
    """Messages of chunks that no damage touches, if the first chunk is among these: it describes the topics."""
    intact = [chunk for chunk in whole.chunks if all(end <= chunk[0] or at >= chunk[1] for at, end in stretches)]
    if whole.chunks[0] in intact:
        for _, _, first, upto in intact:
            yield from whole.messages[first:upto]


# Single cases, in words.


def write(folder: Path, whole: Whole, data: bytes) -> Path:
    path = folder / whole.name
    path.write_bytes(data)
    return path


@PROPERTY
@given(close=st.booleans(), what=harms)
@example(close=False, what=[(zeros, 243, b"abc")])
def test_a_log_that_is_gone_on_with_loses_nothing_in_silence(
    wholes: dict[bool, Whole], tmp_path: Path, close: bool, what: list[Any]
) -> None:
    """All that is intact is in the new file; or the damaged one is kept, and the new one says so."""
    whole, folder = wholes[close], Path(mkdtemp(dir=tmp_path))
    data, first, _ = harm(whole, what)
    old, copied = write(folder, whole, data), folder / "copy.mcap.active"
    copied.write_bytes(data)
    try:
        with LogWriter(folder / "tmc.mcap", "tmc", JournalConfig(), {}, resume=True):
            pass
    except RecordError:
        assert old.read_bytes() == data  # it does not begin as a log does
        return
    found, kept = messages_of(folder / "tmc.mcap"), list(folder.glob("tmc.mcap*.damaged-1"))
    told = [data for topic, _, _, data in found if topic == "/log" and b".damaged-1" in data]
    assert len(told) == len(kept) and Log(folder / "tmc.mcap").finished
    assert found[: flushed_before(whole, first)] == whole.messages[: flushed_before(whole, first)]
    if not kept and found != whole.messages:
        try:
            intact = recover(copied).found.messages
        except RecordError:
            intact = 0
        assert len(found) == intact


def test_a_finished_file_needs_no_recovery(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    result = recover(write(tmp_path, wholes[True], wholes[True].data))
    assert result.out is None and result.clean
    assert [*result.lines()] == [f"{tmp_path / 'tmc.mcap'}: intact and finished, 72 messages; there is nothing to do"]
    assert [p.name for p in tmp_path.iterdir()] == ["tmc.mcap"]


def test_a_file_that_was_not_closed_is_closed(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    result = recover(write(tmp_path, wholes[False], wholes[False].data))
    assert result.clean and result.out == tmp_path / "tmc.recovered.mcap"
    assert "nothing is lost; it was not closed" in [*result.lines()][-1]
    assert messages_of(result.out) == wholes[False].messages and Log(result.out).finished


def test_a_lost_chunk_is_counted_and_what_stands_behind_it_is_kept(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    whole = wholes[False]
    begin, end, first, upto = whole.chunks[4]
    data = bytearray(whole.data)
    data[begin + 60] ^= 1
    result = recover(write(tmp_path, whole, bytes(data)))
    assert result.out is not None
    assert messages_of(result.out) == whole.messages[:first] + whole.messages[upto:]
    assert result.found.missing == upto - first
    assert [(lost.at, lost.bytes) for lost in result.found.lost] == [(begin, end - begin)]
    said = [*result.lines()]
    assert said[1].startswith(f"  lost {end - begin:,} bytes from byte {begin:,} (")
    assert said[2] == "  lost 6 messages, by the gaps in the numbers of the others"
    assert f"{end - begin:,} bytes from byte" in Log(result.out).lost["lost"]


def test_an_opcode_that_hides_a_chunk_is_a_loss(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    whole = wholes[False]
    data = bytearray(whole.data)
    data[whole.chunks[4][0]] = 7
    result = recover(write(tmp_path, whole, bytes(data)))
    assert not result.clean and result.found.missing == 6


def test_topics_that_only_a_lost_chunk_described_are_not_guessed(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    """In a finished file the summary describes them again."""
    for close, kept in ((False, 0), (True, 66)):
        whole = wholes[close]
        data = bytearray(whole.data)
        data[whole.chunks[0][0] + 60] ^= 1
        result = recover(write(tmp_path, whole, bytes(data)), tmp_path / f"{close}.mcap")
        assert result.out is not None and len(messages_of(result.out)) == kept
        assert result.found.nameless == 66 - kept and not result.clean


def test_a_damaged_summary_is_made_anew_and_nothing_is_lost(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    for data in (wholes[True].data[:-30], wholes[True].data[:-30] + bytes(30), wholes[True].data + b"more"):
        result = recover(write(tmp_path, wholes[True], data), tmp_path / f"{len(data) % 97}.mcap")
        assert result.clean and "summary is damaged or cut: it is written again" in "\n".join(result.lines())
        assert result.out is not None and messages_of(result.out) == wholes[True].messages
        result.out.unlink()


def test_in_place_keeps_the_damaged_file_and_gives_the_finished_name(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    path = write(tmp_path, wholes[False], wholes[False].data[:-7])
    result = recover(path, in_place=True)
    assert not result.clean and result.out == tmp_path / "tmc.mcap"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tmc.mcap", "tmc.mcap.active.damaged-1"]
    assert (tmp_path / "tmc.mcap.active.damaged-1").read_bytes() == wholes[False].data[:-7]


def test_what_is_lost_in_two_recoveries_is_told_of_both(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    whole, said = wholes[False], list[str]()
    path, at = write(tmp_path, whole, whole.data), whole.chunks[4][0] + 60
    for n in range(2):
        data = bytearray(path.read_bytes())
        data[at] ^= 1
        path.write_bytes(data)
        result = recover(path, tmp_path / f"{n}.mcap")
        assert result.out is not None
        path, at = result.out, result.out.read_bytes().find(b"\x04\x00\x00\x00zstd") + 30
        said += map(str, result.found.lost)
    assert len(said) == 2 and all(part in Log(path).lost["lost"] for part in said)
    assert Log(path).damage is None and recover(path).out is None


def test_a_recovered_log_is_resumed_with_its_gap(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    whole = wholes[False]
    data = bytearray(whole.data)
    data[whole.chunks[4][0] + 60] ^= 1
    recover(write(tmp_path, whole, bytes(data)), in_place=True)
    with LogWriter(tmp_path / "tmc.mcap", "tmc", JournalConfig(), {}, resume=True) as log:
        log.write("/tmc/sync", schemas.Sync(tick=99))
    again = Log(tmp_path / "tmc.mcap")
    assert len(list(again.raw())) == len(whole.messages) - 6 + 1
    assert again.damage is None and "bytes from byte" in again.lost["lost"]


def test_what_cannot_be_recovered_is_said_and_leaves_nothing(wholes: dict[bool, Whole], tmp_path: Path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("hello, world, this is not a log at all; " * 100)
    with pytest.raises(RecordError, match="holds nothing that is intact: it is not an MCAP file"):
        recover(text)
    with pytest.raises(RecordError, match=r"cannot be read \(No such file"):
        recover(tmp_path / "gone.mcap")
    with pytest.raises(RecordError, match=r"cannot be read \(Is a directory"):
        recover(tmp_path)
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(RecordError, match="is empty"):
        recover(tmp_path / "empty.mcap")
    path = write(tmp_path, wholes[True], wholes[True].data[:-700])
    with pytest.raises(RecordError, match="exists already: choose another --out"):
        recover(path, text)
    with pytest.raises(RecordError, match="exists already: choose another --out"):
        recover(path, path)
    with pytest.raises(RecordError, match=r"gone/x\.mcap cannot be written \(No such file"):
        recover(path, tmp_path / "gone" / "x.mcap")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty.mcap", "text.mcap", "tmc.mcap"]
