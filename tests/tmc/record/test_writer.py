"""The writer: what it writes can be read, what cannot be written is refused in one sentence, a kill costs little."""

import itertools
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tmc.kernel.config import JournalConfig
from tmc.record import builders, overfly_pb2
from tmc.record.errors import RecordError
from tmc.record.reader import Log, read
from tmc.record.run_folder import run_files
from tmc.record.writer import LogWriter

LAZY = JournalConfig(flush_interval=60.0)


def writer(path, process="tmc", **options):
    return LogWriter(path, process, LAZY, {"team.size": "3"}, **options)


def names(folder):
    return [p.name for p in folder.iterdir()]


def sync(tick):
    return overfly_pb2.Sync(episode=1, tick=tick, version=2, policy=3, uavs=[0, 1], believed=0.25)


def messages():
    """One message for every topic that the TMC writes."""
    return {
        "/uav/3/record": overfly_pb2.FlightRecord(uav=3, cells=[1, 2]),
        "/tmc/sync": sync(1),
        "/tmc/episode": overfly_pb2.Episode(episode=1, phase="begin", starts=[4, 5]),
        "/tmc/events": overfly_pb2.Events(episode=1, ticks=[1], cells=[2]),
        "/tmc/metrics": overfly_pb2.TeamMetrics(episode=1, uncertainty=[0.5], reward=[0.0]),
        "/tmc/last_visit": builders.grid(np.arange(6), 2, 3, 60.0, 1),
        "/map/roads": builders.geojson("{}"),
        "/learner/policy": overfly_pb2.Policy(version=1, model=b"x"),
        "/log": builders.log_message("info", "hello", "tmc", 1),
    }


def test_every_topic_comes_back(tmp_path):
    path = tmp_path / "tmc.mcap"
    with writer(path) as log:
        for topic, message in messages().items():
            log.write(topic, message)
        log.attach("config.toml", "application/toml", b"a = 1")
        assert (tmp_path / "tmc.mcap.active").exists() and not path.exists()
    assert names(tmp_path) == ["tmc.mcap"]
    assert {e.topic: e.message for e in read(path)} == messages()
    log = Log(path)
    assert log.finished and log.damage is None
    assert log.metadata() == {"format": "2", "process": "tmc", "clock": "wall", "team.size": "3"}
    assert [(a.name, a.media_type, a.data) for a in log.attachments()] == [
        ("config.toml", "application/toml", b"a = 1")
    ]


def test_log_time_never_decreases_when_the_clock_goes_back(tmp_path):
    clock = itertools.chain([100, 200, 150, 50, 300], itertools.repeat(300)).__next__
    with writer(tmp_path / "tmc.mcap", clock=clock) as log:
        times = [log.write("/tmc/sync", sync(t)) for t in range(5)]
    assert times == [100, 200, 200, 200, 300]
    entries = list(read(tmp_path / "tmc.mcap"))
    assert [e.log_time for e in entries] == times
    assert [e.publish_time for e in entries] == times


def test_sequence_counts_by_channel_and_publish_time_is_the_senders(tmp_path):
    with writer(tmp_path / "tmc.mcap") as log:
        for t in range(3):
            log.write("/tmc/sync", sync(t), publish_time=7 + t)
        log.log("info", "hello")
    entries = list(read(tmp_path / "tmc.mcap"))
    assert [(e.topic, e.sequence) for e in entries] == [
        ("/tmc/sync", 0),
        ("/tmc/sync", 1),
        ("/tmc/sync", 2),
        ("/log", 0),
    ]
    assert [e.publish_time for e in entries[:3]] == [7, 8, 9]


def test_log_says_who_speaks(tmp_path):
    with writer(tmp_path / "uav-003.mcap", "uav-003") as log:
        log.log("warning", "late")
        with pytest.raises(RecordError, match="no log level 'loud': choose one of debug, info"):
            log.log("loud", "late")
    (entry,) = read(tmp_path / "uav-003.mcap")
    assert (entry.message.level, entry.message.message, entry.message.name) == (3, "late", "uav-003")


def test_wrong_topics_and_messages_are_refused_and_change_nothing(tmp_path):
    with writer(tmp_path / "tmc.mcap") as log:
        with pytest.raises(RecordError, match="no topic /tmc/sink: add it to the table"):
            log.write("/tmc/sink", sync(0))
        with pytest.raises(RecordError, match="no topic /uav/03/record"):
            log.write("/uav/03/record", overfly_pb2.FlightRecord())
        with pytest.raises(RecordError, match=r"is written by learner, not by tmc"):
            log.write("/learner/metrics", overfly_pb2.LearnerMetrics())
        with pytest.raises(RecordError, match=r"/tmc/sync holds overfly.Sync, not overfly.Policy"):
            log.write("/tmc/sync", overfly_pb2.Policy())
        with pytest.raises(RecordError, match="publish time -1 does not fit"):
            log.write("/tmc/sync", sync(0), publish_time=-1)
        log.write("/tmc/sync", sync(0))
    assert [e.sequence for e in read(tmp_path / "tmc.mcap")] == [0]
    with pytest.raises(RecordError, match="is closed"):
        log.write("/tmc/sync", sync(1))


def test_nothing_is_written_over(tmp_path):
    writer(tmp_path / "tmc.mcap").close()
    with pytest.raises(RecordError, match=r"tmc.mcap exists already: choose a new run folder, or resume"):
        writer(tmp_path / "tmc.mcap")
    (tmp_path / "learner.mcap.active").write_bytes(b"x")
    with pytest.raises(RecordError, match=r"learner.mcap.active exists already"):
        writer(tmp_path / "learner.mcap", "learner")
    with pytest.raises(RecordError, match=r"must end in .mcap"):
        writer(tmp_path / "tmc.log")


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(RecordError, match=r"gone/tmc.mcap cannot be written \(No such file"):
        writer(tmp_path / "gone" / "tmc.mcap")


def test_a_full_disk_stops_the_log_and_keeps_what_was_flushed(tmp_path):
    """A limit on the file's size stands in for the disk: the write ends half-way, as there."""
    code = f"""
import resource, signal
from tmc.kernel.config import JournalConfig
from tmc.record import overfly_pb2
from tmc.record.errors import RecordError
from tmc.record.writer import LogWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
log = LogWriter({str(tmp_path / "tmc.mcap")!r}, "tmc", JournalConfig(flush_interval=60), {{}})
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
done = 0
try:
    while True:
        log.write("/tmc/sync", overfly_pb2.Sync(tick=done))
        log.flush()
        done += 1
except RecordError as error:
    first = str(error)
log.close()
for call in (log.flush, lambda: log.write("/tmc/sync", overfly_pb2.Sync())):
    try:
        call()
        raise SystemExit("went on")
    except RecordError as error:
        assert str(error) == first
print(done, first)
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    done, _, text = out.partition(" ")
    assert "is as large as a file may be here: run `ulimit -f unlimited` and resume" in text
    assert not (tmp_path / "tmc.mcap").exists()
    log = Log(tmp_path / "tmc.mcap.active")
    ticks = [e.message.tick for e in log.entries()]
    assert ticks == list(range(len(ticks)))
    assert len(ticks) - int(done) in (0, 1)  # the disk may be full right after the last chunk, before its index
    assert log.cut and not log.finished


def test_flush_is_due_after_the_configured_time(tmp_path):
    now = [0.0]
    log = LogWriter(tmp_path / "tmc.mcap", "tmc", JournalConfig(flush_interval=0.5), {}, timer=lambda: now[0])
    held = lambda: len(list(read(tmp_path / "tmc.mcap.active")))  # noqa: E731
    log.write("/tmc/sync", sync(0))
    log.maybe_flush()
    assert held() == 0
    now[0] = 0.5
    log.maybe_flush()
    assert held() == 1
    log.write("/tmc/sync", sync(1))
    assert held() == 1
    now[0] = 1.0
    log.write("/tmc/sync", sync(2))
    assert held() == 3
    log.close()


CHILD = """
import sys
from tmc.kernel.config import JournalConfig
from tmc.record import overfly_pb2
from tmc.record.writer import LogWriter
log = LogWriter(sys.argv[1], "tmc", JournalConfig(flush_interval=60), {})
for tick in range(10**9):
    log.write("/tmc/sync", overfly_pb2.Sync(tick=tick, uavs=range(tick % 7)))
    if tick % 50 == 49:
        log.flush()
        print(tick + 1, flush=True)
"""


@pytest.mark.parametrize("commits", [1, 20, 300])
def test_kill_9_costs_only_what_was_not_flushed(tmp_path, commits):
    path = tmp_path / "tmc.mcap"
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE, text=True)
    flushed = [int(child.stdout.readline()) for _ in range(commits)][-1]
    child.send_signal(signal.SIGKILL)
    flushed = max([flushed, *map(int, child.stdout.read().split())])
    child.wait()
    child.stdout.close()
    log = Log(Path(f"{path}.active"))
    ticks = [e.message.tick for e in log.entries()]
    assert ticks == list(range(len(ticks)))
    assert flushed <= len(ticks) <= flushed + 50
    assert log.cut


def test_resume_goes_on_after_a_kill(tmp_path):
    path, active = tmp_path / "tmc.mcap", tmp_path / "tmc.mcap.active"
    first = writer(path, clock=lambda: 1000)
    first.attach("map", "text/plain", b"m")
    first.write("/tmc/sync", sync(0))
    first.flush()
    whole = active.stat().st_size
    first.write("/tmc/sync", sync(1))
    first.flush()
    first._give_up()
    os.truncate(active, (whole + active.stat().st_size) // 2)
    with writer(path, clock=lambda: 500, resume=True) as second:
        second.write("/tmc/sync", sync(2))
        assert [e.message.tick for e in read(active)] == [0]
    assert names(tmp_path) == ["tmc.mcap"]
    log = Log(path)
    assert [(e.message.tick, e.sequence, e.log_time) for e in log.entries()] == [(0, 0, 1000), (2, 1, 1000)]
    assert [a.data for a in log.attachments()] == [b"m"] and log.finished
    with writer(path, resume=True) as third:
        third.write("/tmc/sync", sync(3))
    assert [e.message.tick for e in read(path)] == [0, 2, 3]


@pytest.mark.parametrize("place", [60, 2], ids=["in a chunk", "in the length of one"])
def test_resume_keeps_a_file_whose_middle_is_damaged_and_says_so(tmp_path, place):
    path, active = tmp_path / "tmc.mcap", tmp_path / "tmc.mcap.active"
    first = writer(path)
    sizes = []
    for t in range(3):
        first.write("/tmc/sync", sync(t))
        first.flush()
        sizes.append(active.stat().st_size)
    first._give_up()
    data = bytearray(active.read_bytes())
    data[sizes[0] + place] ^= 1  # with 2: a length that seems to end behind the file
    active.write_bytes(data)
    assert not Log(active).still_open
    with writer(path, resume=True):
        pass
    assert [e.message.tick for e in read(path, ["/tmc/sync"])] == [0]
    (told,) = (e.message.message for e in read(path, ["/log"]))
    assert f"at byte {sizes[0]}" in told and "tmc.mcap.active.damaged-1" in told
    assert (tmp_path / "tmc.mcap.active.damaged-1").read_bytes() == bytes(data)


def test_resume_of_a_finished_file_that_was_cut_keeps_it(tmp_path):
    path = tmp_path / "tmc.mcap"
    with writer(path) as first:
        for t in range(50):
            first.write("/tmc/sync", sync(t))
            first.flush()
    os.truncate(path, path.stat().st_size // 2)
    size = path.stat().st_size
    with writer(path, resume=True):
        pass
    assert (tmp_path / "tmc.mcap.damaged-1").stat().st_size == size
    assert any("tmc.mcap.damaged-1" in e.message.message for e in read(path, ["/log"]))


def test_an_empty_file_takes_no_sound_ones_place(tmp_path):
    path, active = tmp_path / "tmc.mcap", tmp_path / "tmc.mcap.active"
    with writer(path) as first:
        first.write("/tmc/sync", sync(7))
    active.touch()
    assert run_files(tmp_path) == {"tmc": path}
    with writer(path, resume=True):
        pass
    assert [e.message.tick for e in read(path)] == [7] and names(tmp_path) == ["tmc.mcap"]


def test_what_each_life_said_of_itself_is_kept(tmp_path):
    path = tmp_path / "tmc.mcap"
    for _ in range(3):
        writer(path, resume=True).close()
    assert [note.name for note in Log(path).extras()] == ["overfly/tmc"] * 3


def test_resume_of_nothing_is_a_fresh_start(tmp_path):
    (tmp_path / "tmc.mcap.active").touch()
    for name in ("tmc.mcap", "learner.mcap"):
        writer(tmp_path / name, name.partition(".")[0], resume=True).close()
        assert Log(tmp_path / name).finished
