"""Facts of a run follow from tmc.mcap alone; repeats are dropped, contradictions refused."""

import hashlib
import struct

import pytest

from tmc.kernel.config import JournalConfig
from tmc.record import overfly_pb2, queries
from tmc.record.channels import uav_topic
from tmc.record.errors import RecordError
from tmc.record.writer import LogWriter


def record(uav, sequence, episode, first, cells):
    return overfly_pb2.FlightRecord(
        uav=uav, sequence=sequence, episode=episode, first=first, tick=first + len(cells) - 1, cells=cells
    )


def write(folder, records, others=()):
    folder.mkdir(exist_ok=True)
    with LogWriter(folder / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        for r in records:
            log.write(uav_topic(r.uav, "record"), r)
        for topic, message in others:
            log.write(topic, message)
    return folder


FLOWN = [
    record(0, 0, 1, 0, [5, 6, 7]),
    record(1, 0, 1, 0, [9, 9]),
    record(1, 1, 1, 2, [8]),
    record(1, 2, 2, 0, [3, 4]),
    record(0, 1, 2, 0, [1]),
    record(0, 2, 2, 1, [2]),
]
MOVES = {
    1: [(0, 0, 5), (0, 1, 9), (1, 0, 6), (1, 1, 9), (2, 0, 7), (2, 1, 8)],
    2: [(0, 0, 1), (0, 1, 3), (1, 0, 2), (1, 1, 4)],
}


def test_moves(tmp_path):
    folder = write(tmp_path / "run", FLOWN)
    assert {e: list(queries.moves(folder, e)) for e in (1, 2)} == MOVES


def test_repeats_and_overlaps_are_dropped(tmp_path):
    twice = [*FLOWN, FLOWN[0], record(0, 7, 1, 1, [6, 7]), record(0, 0, 1, 0, [4, 4, 4])]
    folder = write(tmp_path / "run", twice)
    assert list(queries.moves(folder, 1)) == MOVES[1]
    assert queries.digest(folder) == queries.digest(write(tmp_path / "once", FLOWN))


def test_a_contradiction_is_refused(tmp_path):
    folder = write(tmp_path / "run", [*FLOWN, record(0, 7, 1, 1, [6, 8])])
    with pytest.raises(RecordError, match="disagree where UAV 0 was at tick 2 of episode 1"):
        queries.moves(folder, 1)


def test_a_gap_is_left_open(tmp_path):
    folder = write(tmp_path / "run", [record(0, 0, 1, 2, [5]), record(0, 1, 1, 0, [4])])
    assert list(queries.moves(folder, 1)) == [(0, 0, 4), (2, 0, 5)]


def test_digest_is_what_the_document_says(tmp_path):
    folder = write(tmp_path / "run", FLOWN)
    quads = sorted((e, t, u, c) for e, rows in MOVES.items() for t, u, c in rows)
    assert queries.digest(folder) == hashlib.sha256(b"".join(struct.pack("<4I", *q) for q in quads)).hexdigest()
    assert queries.digest(folder) == "5cfd5847c6898ecf9d3a313ccf0bef682863b2e7ab525b1787d8a8983872b7a5"
    shuffled = write(tmp_path / "other", [FLOWN[i] for i in (3, 1, 0, 4, 2, 5)])
    assert queries.digest(shuffled) == queries.digest(folder)
    assert queries.digest(write(tmp_path / "less", FLOWN[:-1])) != queries.digest(folder)


def test_an_active_log_has_facts_too(tmp_path):
    write(tmp_path / "run", FLOWN)
    (tmp_path / "run" / "tmc.mcap").rename(tmp_path / "run" / "tmc.mcap.active")
    assert list(queries.moves(tmp_path / "run", 2)) == MOVES[2]


def test_uncertainty_events_and_episodes(tmp_path):
    begin = overfly_pb2.Episode(episode=1, phase="begin", starts=[5, 9])
    others = [
        ("/tmc/episode", begin),
        ("/tmc/events", overfly_pb2.Events(episode=1, ticks=[2, 1], cells=[4, 8])),
        ("/tmc/events", overfly_pb2.Events(episode=1, ticks=[2], cells=[4])),
        ("/tmc/metrics", overfly_pb2.TeamMetrics(episode=1, first=2, uncertainty=[2.0])),
        ("/tmc/metrics", overfly_pb2.TeamMetrics(episode=1, first=0, uncertainty=[0.0, 1.0])),
        ("/tmc/metrics", overfly_pb2.TeamMetrics(episode=1, first=1, uncertainty=[1.0, 2.0])),
        ("/tmc/episode", overfly_pb2.Episode(episode=2, phase="begin")),
    ]
    folder = write(tmp_path / "run", FLOWN, others)
    assert list(queries.uncertainty(folder, 1)) == [(0, 0.0), (1, 1.0), (2, 2.0)]
    assert list(queries.events(folder, 1)) == [(1, 8), (2, 4)]
    assert list(queries.events(folder, 2)) == []
    assert [e.phase for e in queries.episodes(folder)] == ["begin", "begin"] and queries.episodes(folder)[0] == begin


def test_a_missing_episode_is_named_with_those_that_are_there(tmp_path):
    flown = [record(0, n, e, 0, [1]) for n, e in enumerate((1, 2, 3, 7))]
    folder = write(tmp_path / "run", flown, [("/tmc/metrics", overfly_pb2.TeamMetrics(episode=1))])
    with pytest.raises(RecordError, match="holds nothing of episode 5: ask for one of 1 to 3, 7"):
        queries.moves(folder, 5)
    with pytest.raises(RecordError, match=r"episode 2: ask for one of 1$"):
        queries.uncertainty(folder, 2)
    with pytest.raises(RecordError, match="episode 1: ask for one of those that are flown from now on"):
        queries.events(folder, 1)


def test_a_folder_without_the_tmc(tmp_path):
    (tmp_path / "uav-000.mcap").touch()
    with pytest.raises(RecordError, match=r"holds no tmc.mcap"):
        queries.digest(tmp_path)
