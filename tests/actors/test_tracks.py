"""The shared table of tracks: the word alone tells a reader what it holds."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import pytest

from actors.tracks import TableTracks, TrackTable, create_table, open_table
from tests.command import PATIENCE_S


def test_what_is_published_is_read_and_nothing_else() -> None:
    table = TrackTable(3, 10)
    views = [TableTracks(table, i) for i in range(3)]
    for view in views:
        view.start_episode(1, [4, 5, 6])
    assert [views[0].newest(j) for j in range(3)] == [(0, 4), (0, 5), (0, 6)]
    views[1].publish(0, 5)
    views[1].publish(1, 15)
    views[1].publish(2, 25)
    for view in views:
        assert view.newest(1) == (2, 25)
        assert [view.at(1, t) for t in range(11)] == [5, 15, 25] + [-1] * 8
        assert view.newest(2) == (0, 6) and view.at(2, 1) == -1
    assert [views[0].at(0, t) for t in (0, 1)] == [4, -1]


def test_a_new_episode_hides_the_slots_of_the_old_one() -> None:
    """For each UAV separately: one may be in the next episode while another's words belong to the last one."""
    table = TrackTable(2, 4)
    a, b = TableTracks(table, 0), TableTracks(table, 1)
    for view in (a, b):
        view.start_episode(1, [0, 1])
    for t in range(5):
        a.publish(t, 10 + t)
        b.publish(t, 20 + t)
    a.start_episode(2, [7, 8])
    assert a.newest(1) == (0, 8) and [a.at(1, t) for t in range(5)] == [8, -1, -1, -1, -1]
    a.publish(0, 7)
    b.start_episode(2, [7, 8])
    b.publish(0, 8)
    b.publish(1, 9)
    assert a.newest(1) == (1, 9) and [a.at(1, t) for t in range(5)] == [8, 9, -1, -1, -1]
    assert b.newest(0) == (0, 7)


@pytest.mark.parametrize("episode", [1, 2**31 - 1])
def test_the_largest_values_fit(episode: int) -> None:
    table = TrackTable(1, 60_000)
    tracks = TableTracks(table, 0)
    tracks.start_episode(episode, [65_534])
    tracks.publish(60_000, 65_534)
    assert tracks.newest(0) == (60_000, 65_534) and tracks.at(0, 60_000) == 65_534


def test_a_process_that_starts_again_writes_the_same() -> None:
    """It resumes at its last record. What it had published after that stays readable, and is published again."""
    table = TrackTable(2, 20)
    peer = TableTracks(table, 1)
    peer.start_episode(3, [0, 9])
    cells = [0, 1, 2, 3, 4, 5, 6, 7]
    first = TableTracks(table, 0)
    first.start_episode(3, [0, 9])
    for t, cell in enumerate(cells):
        first.publish(t, cell)
    words = bytes(table.words)
    again = TableTracks(table, 0)
    again.start_episode(3, [0, 9])
    again.publish(5, cells[5])
    assert [peer.at(0, t) for t in range(8)] == cells
    assert peer.newest(0) == (5, 5)
    for t in (6, 7):
        again.publish(t, cells[t])
    assert bytes(table.words) == words


def _publish(path: Path) -> None:
    tracks = TableTracks(open_table(path, 2, 10), 1)
    tracks.start_episode(1, [0, 1])
    tracks.publish(3, 42)


def test_two_processes_share_a_file(tmp_path: Path) -> None:
    path = tmp_path / "tracks"
    create_table(path, 2, 10)
    assert path.stat().st_size == 8 * 2 * 13 and not any(path.read_bytes())
    mine = TableTracks(open_table(path, 2, 10), 0)
    mine.start_episode(1, [0, 1])
    process = multiprocessing.get_context("spawn").Process(target=_publish, args=(path,))
    process.start()
    process.join(PATIENCE_S)
    assert process.exitcode == 0
    assert mine.newest(1) == (3, 42) and mine.at(1, 3) == 42


def _publish_slowly(path: Path) -> None:
    tracks = TableTracks(open_table(path, 2, 10), 1)
    tracks.start_episode(1, [0, 1])
    for tick in range(1, 6):
        time.sleep(0.05)
        tracks.publish(tick, 40 + tick)


def test_a_uav_is_woken_by_the_tick_that_it_waits_for(tmp_path: Path) -> None:
    path = tmp_path / "tracks"
    create_table(path, 2, 10)
    mine = TableTracks(open_table(path, 2, 10), 0)
    mine.start_episode(1, [0, 1])
    process = multiprocessing.get_context("spawn").Process(target=_publish_slowly, args=(path,))
    process.start()
    looks, give_up = 0, time.monotonic() + PATIENCE_S
    while mine.newest(1)[0] < 5 and time.monotonic() < give_up:
        mine.wait(1, 5, 10.0)
        looks += 1
    process.join(PATIENCE_S)
    assert mine.at(1, 5) == 45
    assert looks <= 6, "woken by what is published, not by looking again and again"


def test_a_wait_for_what_is_there_or_never_comes_ends(tmp_path: Path) -> None:
    table = TrackTable(2, 10)
    mine, peer = TableTracks(table, 0), TableTracks(table, 1)
    for tracks in (mine, peer):
        tracks.start_episode(1, [0, 1])
    peer.publish(3, 7)
    start = time.monotonic()
    mine.wait(1, 3, 2 * PATIENCE_S)
    assert time.monotonic() - start < PATIENCE_S
    mine.wait(1, 4, 0.01)
    assert mine.newest(1) == (3, 7)


def test_a_table_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "tracks"
    path.write_text("mine")
    with pytest.raises(FileExistsError):
        create_table(path, 2, 10)
    assert path.read_text() == "mine"


@pytest.mark.parametrize(("team", "ticks"), [(3, 10), (2, 11), (2, 9)])
def test_a_table_of_another_size_is_refused(tmp_path: Path, team: int, ticks: int) -> None:
    path = tmp_path / "tracks"
    create_table(path, 2, 10)
    with pytest.raises(ValueError, match=rf"has 208 bytes, expected {8 * team * (ticks + 3)}"):
        open_table(path, team, ticks)


def test_a_missing_table_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="tracks"):
        open_table(tmp_path / "tracks", 2, 10)
    (tmp_path / "empty").touch()
    with pytest.raises(ValueError, match="0 bytes"):
        open_table(tmp_path / "empty", 2, 10)
