"""UAVs that know more than a restarted TMC resend everything in its turn, and no process waits for ever."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from tmc.center.reorder_buffer import MAX_BUFFERED_RECORDS
from tmc.center.roster import uav_name
from tmc.center.station import Station
from tmc.kernel.config import build
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World
from tmc.wire import messages as m

VALUES = {"team.size": 3, "training.ticks": 40, "comms.period": 5, "team.controller": "planner:greedy"}


@pytest.fixture(params=["together", "staggered"])
def flown(request: pytest.FixtureRequest, mission: Callable[..., Any], town: RoadMap) -> Any:
    """A mission that nothing befell."""
    return mission({**VALUES, "comms.phase": request.param}, town).play()


def started_again(flown: Any, incarnation: int = 1) -> Station:
    """A station that knows nothing yet of what was flown."""
    station = Station(flown.world, "run", learning=False)
    for i in range(flown.N):
        station.handle(uav_name(i), m.Hello("uav", i, incarnation), 1.0)
    station.out.take()
    return station


def told(station: Station, records: list[m.Record]) -> list[Any]:
    """What is journalled when the records come in this order."""
    for record in records:
        station.handle(uav_name(record.uav), record, 2.0)
    out = station.out.take()
    assert not [x for _, x in out.sends if isinstance(x, m.Error)]
    return out.entries


def test_records_of_one_uav_after_the_other_are_taken_in_their_turn(flown: Any) -> None:
    """Each UAV says all of its episode at once, as after a long time without a commit."""
    station = started_again(flown)
    entries = told(station, sorted(flown.records, key=lambda r: r.uav))
    assert station.phase == "done"
    known = [-1] * flown.N
    exchanged = -1
    for entry in entries:
        if "record" in entry.values:
            record = entry.values["record"]
            assert record.first == known[record.uav] + 1
            assert record.first - 1 <= exchanged, "a record stands before the exchange that it was flown on from"
            known[record.uav] = record.tick
        elif entry.topic == "/tmc/sync":
            exchanged = entry.values["tick"]
    assert min(known) == flown.T
    states = [e.values for e in entries if e.topic == "/tmc/state"]
    assert states == [e.values for e in flown.entries if e.topic == "/tmc/state"]


def test_a_new_process_is_not_answered_by_what_the_old_one_said_early(flown: Any) -> None:
    station = started_again(flown)
    mine = [r for r in flown.records if r.uav == 0]
    told(station, mine[:3])
    assert station.reorder_buffer.count(0) == 3 - station.roster[0].sequence > 0
    station.handle("uav-000", m.Hello("uav", 0, 2), 3.0)
    assert station.reorder_buffer.count(0) == 0
    again = [replace(r, incarnation=2) for r in mine[station.roster[0].sequence :]]
    others = [r for r in flown.records if r.uav != 0]
    station.out.take()
    told(station, [*again, *others])
    assert station.phase == "done"


def test_a_repeat_of_an_early_record_is_dropped_in_silence(flown: Any) -> None:
    station = started_again(flown)
    mine = [r for r in flown.records if r.uav == 1][:3]
    told(station, mine)
    assert told(station, mine[1:]) == [] and station.reorder_buffer.count(1) == 2 and not station.rejected


def test_early_records_have_an_end(flown: Any) -> None:
    station = started_again(flown)
    mine = [r for r in flown.records if r.uav == 1]
    told(station, mine[:2])
    for k in range(2, MAX_BUFFERED_RECORDS + 10):
        station.handle("uav-001", replace(mine[1], sequence=k), 2.0)
    assert station.reorder_buffer.count(1) == MAX_BUFFERED_RECORDS


def alive(station: Station, **more: int) -> list[m.Message]:
    """What the station says to UAV 0 that is alive."""
    station.handle("uav-000", replace(m.Alive(0, 1, 20, 2, 0), **more), 2.0)
    return [x for to, x in station.out.take().sends if to == "uav-000"]


def test_a_uav_that_waits_with_records_that_the_tmc_misses_is_told_to_say_hello(flown: Any) -> None:
    """It has its answer of an earlier incarnation of the TMC; without its record no exchange can be held."""
    station = started_again(flown)
    mine = [r for r in flown.records if r.uav == 0]
    (error,) = alive(station, sequence=1)
    assert isinstance(error, m.Error) and error.code == "state"
    told(station, mine[:2])
    assert alive(station, sequence=2) == []
    assert [x.code for x in alive(station, sequence=3) if isinstance(x, m.Error)] == ["state"]


def test_a_process_that_said_hello_to_an_earlier_life_of_the_tmc_is_not_fenced(flown: Any) -> None:
    """The journal knows the processes that have shipped a record; a newer one may be on its first episode."""
    station = started_again(flown)
    mine = next(r for r in flown.records if r.uav == 0)
    assert [x.code for x in alive(station, incarnation=7) if isinstance(x, m.Error)] == ["state"]
    station.handle("uav-000", replace(mine, incarnation=7), 2.0)
    (error,) = (x for _, x in station.out.take().sends)
    assert isinstance(error, m.Error) and error.code == "state"
    station.handle("uav-000", m.Hello("uav", 0, 7), 2.0)
    station.out.take()
    told(station, [replace(mine, incarnation=7)])
    station.handle("uav-000", replace(mine, incarnation=1), 2.0)
    assert [x.code for _, x in station.out.take().sends if isinstance(x, m.Error)] == ["fenced"]
    assert alive(station, incarnation=1, sequence=9) == []


def test_the_next_process_flies_the_policy_of_the_last_one(town: RoadMap) -> None:
    """Peers may have seen what the last one flew by it, so a newer policy has to wait for the next exchange."""
    config = build({**VALUES, "team.controller": "policy", "team.size": 1})
    station = Station(World(config, town), "run", learning=True)
    station.handle("learner", m.Hello("learner", -1, 5), 1.0)
    station.handle("learner", m.PolicyPush(1, 0, 0.0, b"one"), 1.0)
    station.handle("uav-000", m.Hello("uav", 0, 1), 1.0)
    assert [x.policy for _, x in station.out.take().sends if isinstance(x, m.Begin)] == [1]
    station.handle("learner", m.PolicyPush(2, 9, 0.0, b"two"), 1.0)
    station.handle("learner", m.PolicyPush(3, 10, 0.0, b"three"), 1.0)
    station.handle("uav-000", m.Hello("uav", 0, 2), 2.0)
    assert [x.policy for _, x in station.out.take().sends if isinstance(x, m.Begin)] == [1]
    station.handle("uav-000", m.PolicyRequest(1), 2.0)
    assert [x for _, x in station.out.take().sends] == [m.Policy(1, b"one")]
