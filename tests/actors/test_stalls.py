"""Stalls of a trial are addressed draws, and change nothing but the time. The largest lead of a UAV is kept."""

from __future__ import annotations

from typing import Any

import pytest

from actors.stalls import Lead, StallingTracks, can_stall, stall_s
from actors.tracks import TableTracks, TrackTable
from tmc.kernel.config import Config, build


def config(**trial: Any) -> Config:
    return build({f"trial.{name}": value for name, value in trial.items()})


def test_ordinary_missions_have_none() -> None:
    assert not can_stall(Config(), 0)


@pytest.mark.parametrize(("uav", "stalling"), [(-1, [0, 1, 2]), (1, [1])])
def test_all_stall_or_one(uav: int, stalling: list[int]) -> None:
    assert [i for i in range(3) if can_stall(config(stall=0.01, stall_uav=uav), i)] == stalling


def test_a_share_of_the_ticks_for_times_around_the_mean() -> None:
    c = config(stall=0.01, stall_share=0.2, stall_spread=0.5)
    times = [stall_s(c, 1, tick, 0) for tick in range(5000)]
    some = [t for t in times if t]
    assert len(some) == pytest.approx(1000, rel=0.1)
    assert sum(some) / len(some) == pytest.approx(0.01, rel=0.05)
    assert 0.005 <= min(some) < 0.0052 and 0.0148 < max(some) <= 0.015


def test_without_spread_each_lasts_as_long() -> None:
    assert {stall_s(config(stall=0.1), 1, tick, 3) for tick in range(100)} == {0.1}


def test_a_draw_is_a_function_of_its_address() -> None:
    c = config(stall=0.01, stall_share=0.5, stall_spread=1.0)
    here = [stall_s(c, 1, tick, 2) for tick in range(50)]
    assert here == [stall_s(c, 1, tick, 2) for tick in range(50)]
    assert here != [stall_s(c, 2, tick, 2) for tick in range(50)]
    assert here != [stall_s(c, 1, tick, 1) for tick in range(50)]
    assert here != [stall_s(build({"training.seed": 9}, c), 1, tick, 2) for tick in range(50)]


def test_tracks_are_the_same_but_for_the_time() -> None:
    table, slept = TrackTable(2, 10), list[float]()
    slow = StallingTracks(TableTracks(table, 0), config(stall=0.1), 0, slept.append)
    peer = TableTracks(table, 1)
    for tracks in (slow, peer):
        tracks.start_episode(1, [4, 5])
    slow.publish(0, 4)
    assert slept == []  # at tick 0 it has not flown yet
    slow.publish(1, 14)
    slow.publish(2, 24)
    assert slept == [0.1, 0.1]
    assert peer.newest(0) == slow.newest(0) == (2, 24)
    assert [slow.at(0, t) for t in range(4)] == [4, 14, 24, -1]


def test_a_restarted_process_publishes_again_without_stalls() -> None:
    table, slept = TrackTable(1, 10), list[float]()
    for _incarnation in range(2):
        tracks = StallingTracks(TableTracks(table, 0), config(stall=0.1), 0, slept.append)
        tracks.start_episode(1, [4])
        for tick in range(4):
            tracks.publish(tick, tick)
    assert slept == [0.1] * 3


def test_the_largest_lead_is_kept() -> None:
    lead = Lead()
    for ticks, tick, bound in ((3, 5, "distance"), (7, 9, "exchange"), (7, 11, "end"), (2, 20, "end")):
        lead.update(ticks, tick, bound)
    assert lead == Lead(7, 9, "exchange")
