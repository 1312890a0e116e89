"""The reader: a file may be cut anywhere or damaged anywhere, and still nothing is invented."""

import io
import os

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from tmc.kernel.config import JournalConfig
from tmc.record import channels, schemas
from tmc.record.errors import RecordError
from tmc.record.reader import Log, info, read
from tmc.record.run_folder import run_files
from tmc.record.writer import LogWriter

TICKS = 12


def make(path, close=True):
    log = LogWriter(path, "tmc", JournalConfig(flush_interval=60.0), {"seed": "1"}, clock=lambda: 10**18)
    for tick in range(TICKS):
        log.write("/tmc/sync", schemas.Sync(episode=1, tick=tick, uavs=[0, 1, 2], believed=tick / 3))
        if tick % 4 == 3:
            log.flush()
    log.attach("a", "text/plain", b"some text")
    if close:
        log.close()
    else:
        log.flush()
        log._give_up()
    return (path if close else path.with_name(path.name + ".active")).read_bytes()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return make(tmp_path_factory.mktemp("finished") / "tmc.mcap")


@pytest.fixture(scope="module")
def active(tmp_path_factory):
    return make(tmp_path_factory.mktemp("active") / "tmc.mcap", close=False)


def facts(path, all_of_it=True):
    """(ticks, facts, attachments, damage); checks that each message is whole."""
    log = Log(path)
    ticks = []
    for e in log.entries():
        assert e.message == schemas.Sync(episode=1, tick=e.sequence, uavs=[0, 1, 2], believed=e.sequence / 3)
        ticks.append(e.message.tick)
    if not all_of_it:
        return ticks, {}, [], log.damage
    return ticks, log.metadata(), [a.data for a in log.attachments()], log.damage


@pytest.mark.parametrize("use", [lambda p: list(read(p)), lambda p: Log(p).damage, lambda p: Log(p).metadata(), info])
def test_a_log_of_another_format_is_refused_with_both_versions(tmp_path, monkeypatch, use):
    path = tmp_path / "tmc.mcap"
    monkeypatch.setattr(channels, "FORMAT", "1")
    make(path)
    with pytest.raises(
        RecordError, match=r"tmc\.mcap was written in log format 1, this version reads 2: use the version"
    ):
        use(path)


def test_metadata_of_other_makers_may_have_a_format_of_its_own(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("camera", {"format": "jpeg"})
        writer.finish()
    assert Log(path).metadata() == {"format": "jpeg"}


def test_cut_anywhere(tmp_path, finished):
    """What is left is a beginning of what was, at the bounds of chunks, and the note says that it is cut."""
    path = tmp_path / "tmc.mcap"
    lengths = set()
    for size in [*range(1, 60), *range(60, len(finished) - 60, 3), *range(len(finished) - 60, len(finished))]:
        path.write_bytes(finished[:size])
        ticks, _, attachments, damage = facts(path, size % 5 == 0)
        assert ticks == list(range(len(ticks)))
        assert attachments in ([], [b"some text"])
        assert damage is not None and "it is cut, at byte" in damage
        assert Log(path).cut
        lengths.add(len(ticks))
    assert lengths == {0, 4, 8, 12}
    path.write_bytes(finished)
    assert facts(path)[0] == list(range(TICKS)) and Log(path).damage is None


def test_an_active_file_is_sound_without_an_end(tmp_path, active):
    path = tmp_path / "tmc.mcap.active"
    path.write_bytes(active)
    assert facts(path) == (list(range(TICKS)), Log(path).metadata(), [b"some text"], None)
    assert not Log(path).finished and Log(path).cut
    path.write_bytes(active[:-1])
    assert "it is cut" in Log(path).damage


def test_a_flipped_byte_is_noticed_wherever_it_is(tmp_path, finished):
    """In a finished file, with all bits of the byte flipped or with one."""
    path = tmp_path / "tmc.mcap"
    for at in [*range(60), *range(60, len(finished) - 60, 2), *range(len(finished) - 60, len(finished))]:
        bad = bytearray(finished)
        bad[at] ^= 0xFF if at % 4 else 1 << at // 4 % 8
        path.write_bytes(bad)
        if at < 8:
            with pytest.raises(RecordError, match="is not an MCAP file"):
                Log(path)
            continue
        ticks, _, attachments, damage = facts(path, at % 8 == 0)
        assert ticks == list(range(len(ticks)))
        assert attachments in ([], [b"some text"])
        assert damage is not None, f"byte {at}"


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(at=st.integers(8, 10**6), new=st.binary(min_size=1, max_size=40), drop=st.integers(0, 40))
def test_an_active_file_with_a_damaged_stretch_invents_nothing(tmp_path, active, at, new, drop):
    path = tmp_path / "tmc.mcap.active"
    at %= len(active)
    path.write_bytes(active[: max(at, 8)] + new + active[max(at, 8) + drop :])
    ticks, _, attachments, _ = facts(path)
    assert ticks == list(range(len(ticks)))
    assert attachments in ([], [b"some text"])


def test_a_chunk_that_went_missing_ends_the_reading(tmp_path):
    """A damaged opcode hides a whole chunk: the numbers of the messages show the gap."""
    path = tmp_path / "tmc.mcap"
    log = LogWriter(path, "tmc", JournalConfig(flush_interval=60.0), {})
    bounds = []
    for tick in range(3):
        bounds.append((tmp_path / "tmc.mcap.active").stat().st_size)
        log.write("/tmc/sync", schemas.Sync(tick=tick))
        log.flush()
    log._give_up()
    data = bytearray((tmp_path / "tmc.mcap.active").read_bytes())
    assert data[bounds[1]] == 6
    data[bounds[1]] = 7
    path.write_bytes(data)
    damaged = Log(path)
    assert [e.message.tick for e in damaged.entries()] == [0]
    assert "messages are missing before number 2" in damaged.damage and not damaged.cut


def test_topics_are_chosen(tmp_path):
    with LogWriter(tmp_path / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        log.write("/tmc/sync", schemas.Sync(tick=1))
        log.log("info", "hello")
    assert [e.topic for e in read(tmp_path / "tmc.mcap", ["/log"])] == ["/log"]
    assert [e.topic for e in read(tmp_path / "tmc.mcap", [])] == []


def test_a_schema_that_only_the_file_knows(tmp_path):
    from google.protobuf import descriptor_pb2, duration_pb2  # noqa: PLC0415

    files = descriptor_pb2.FileDescriptorSet()
    duration_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    schema = writer.register_schema("google.protobuf.Duration", "protobuf", files.SerializeToString())
    channel = writer.register_channel("/other", "protobuf", schema)
    writer.add_message(channel, 1, duration_pb2.Duration(seconds=5).SerializeToString(), 1)
    writer.finish()
    (tmp_path / "x.mcap").write_bytes(out.getvalue())
    (entry,) = read(tmp_path / "x.mcap")
    assert entry.message.seconds == 5


def test_what_is_no_log_is_refused_with_the_mend(tmp_path):
    with pytest.raises(RecordError, match=r"gone.mcap cannot be read \(No such file.*give the file"):
        Log(tmp_path / "gone.mcap")
    with pytest.raises(RecordError, match=r"cannot be read \(Is a directory\)"):
        read(tmp_path)
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(RecordError, match="is empty: its process was killed before it wrote"):
        Log(tmp_path / "empty.mcap")
    (tmp_path / "text.mcap").write_text("hello, world")
    with pytest.raises(RecordError, match="is not an MCAP file"):
        info(tmp_path / "text.mcap")


def test_run_files(tmp_path):
    with pytest.raises(RecordError, match="holds no logs of a run"):
        run_files(tmp_path)
    with pytest.raises(RecordError, match="holds no logs of a run"):
        run_files(tmp_path / "gone")
    names = [
        "uav-010.mcap",
        "uav-002.mcap.active",
        "tmc.mcap",
        "tmc.mcap.active",
        "learner.mcap",
        "x.mcap",
        "tmc.mcap.new",
    ]
    for name in names:
        (tmp_path / name).touch()
    os.mkfifo(tmp_path / "uav-011.mcap")  # a process that opened it to read would wait for ever
    (tmp_path / "uav-012.mcap").mkdir()
    found = {process: path.name for process, path in run_files(tmp_path).items()}
    assert list(found.items()) == [
        ("tmc", "tmc.mcap.active"),
        ("learner", "learner.mcap"),
        ("uav-002", "uav-002.mcap.active"),
        ("uav-010", "uav-010.mcap"),
    ]


def test_info(tmp_path, finished):
    path = tmp_path / "tmc.mcap"
    path.write_bytes(finished)
    found = info(path)
    assert (found.bytes, found.finished, found.damage) == (len(finished), True, None)
    assert found.topics["/tmc/sync"].count == TICKS and found.topics["/tmc/sync"].schema == "overfly.Sync"
    assert found.first == found.last == 10**18
    path.write_bytes(finished[:20])
    assert info(path).first is None and "it is cut" in info(path).damage
