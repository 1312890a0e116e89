"""Two logs compared fact by fact: each kind of change is found where it is; what depends on time is not compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tmc.kernel.config import JournalConfig
from tmc.record import compare, schemas
from tmc.record.channels import uav_topic
from tmc.record.errors import RecordError
from tmc.record.reader import read
from tmc.record.run_folder import run_files
from tmc.record.writer import LogWriter

Change = Callable[[str, Any], Iterator[Any]]


def log_of_two(folder: Path) -> Path:
    """Two UAVs, ticks 0 to 4, T_u = 2: scenario-II maps and scenario-I events in one log, as no mission has them."""
    folder.mkdir()
    with LogWriter(folder / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        log.write("/tmc/episode", schemas.Episode(episode=1, phase="begin", starts=[10, 20]))
        for first, tick in ((0, 0), (1, 2), (3, 4)):
            for uav in (0, 1):
                log.write(uav_topic(uav, "record"), flown(uav, first, tick))
            log.write("/tmc/sync", schemas.Sync(episode=1, tick=tick, version=tick + 1, uavs=[0, 1], believed=0.5))
            log.write("/tmc/last_visit", grid(tick))
            ticks = range(first, tick + 1)
            values = {"uncertainty": [0.1 * t for t in ticks], "reward": [0.25 * t for t in ticks]}
            log.write("/tmc/metrics", schemas.TeamMetrics(episode=1, first=first, steps=2 * tick, **values))
        log.write("/tmc/events", schemas.Events(episode=1, ticks=[1, 1, 3], cells=[4, 9, 2]))
        log.write("/tmc/episode", schemas.Episode(episode=1, phase="end", ticks=4, reward=[1.0, 2.0]))
    for uav in (0, 1):
        with LogWriter(folder / f"uav-00{uav}.mcap", f"uav-00{uav}", JournalConfig(), {}) as log:
            for first, tick in ((0, 0), (1, 2), (3, 4)):
                hashes = [100 * uav + t for t in range(max(first, 1) - 1, tick)]
                message = schemas.ObservationHashes(uav=uav, episode=1, first=first, tick=tick, hashes=hashes)
                log.write(uav_topic(uav, "observation_hash"), message)
            log.write(uav_topic(uav, "status"), schemas.UavStatus(uav=uav, waited=0.25 * uav))
    return folder


def flown(uav: int, first: int, tick: int) -> Any:
    ticks, moves = range(first, tick + 1), range(max(first, 1), tick + 1)
    return schemas.FlightRecord(
        uav=uav, incarnation=77, sequence=tick // 2, episode=1, first=first, tick=tick, version=max(tick - 1, 0),
        cells=[10 + 10 * uav + t for t in ticks], actions=[3 for _ in moves], blocks=[0 for _ in moves],
        rewards=[0.5 * t for t in moves], seen_tick=[t for t in ticks if t], seen_cell=[50 + t for t in ticks if t],
    )  # fmt: skip


def grid(tick: int) -> Any:
    import numpy as np  # noqa: PLC0415

    from tmc.record import builders  # noqa: PLC0415

    return builders.grid(np.arange(6, dtype=np.uint32) * tick, 2, 3, 60.0, 1)


def altered(folder: Path, to: Path, change: Change) -> Path:
    """A copy of a run's logs; `change` gives the messages that stand for a message."""
    to.mkdir()
    for name, path in run_files(folder).items():
        with LogWriter(to / path.name, name, JournalConfig(), {}) as log:
            for entry in read(path):
                for message in change(entry.topic, entry.message):
                    log.write(entry.topic, message)
    return to


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return log_of_two(tmp_path_factory.mktemp("compare") / "original")


def setting(topic: str, field: str, at: int, value: Any, **where: Any) -> Change:
    """Changes one value of a repeated field (or a field itself, `at` = -1) in the messages that `where` describes."""

    def change(name: str, message: Any) -> Iterator[Any]:
        if name == topic and all(getattr(message, key) == wanted for key, wanted in where.items()):
            if at < 0:
                setattr(message, field, value)
            else:
                getattr(message, field)[at] = value
        yield message

    return change


def visit_of_cell_4(name: str, message: Any) -> Iterator[Any]:
    """Row 1 of the map is row 0 of the Grid: cell 4 is its second value."""
    if name == "/tmc/last_visit" and message.data[4:8] == (8).to_bytes(4, "little"):
        message.data = message.data[:4] + (9).to_bytes(4, "little") + message.data[8:]
    elif name == "/tmc/last_visit" and message.data[4:8] == (16).to_bytes(4, "little"):
        message.data = bytes(24)  # a later difference: the first one is what is named
    yield message


RECORD = "/uav/1/record"
CHANGES: list[tuple[Change, str, int, int]] = [
    (setting(RECORD, "cells", 1, 99, tick=2), "cell", 2, 1),
    (setting(RECORD, "actions", 0, 8, tick=2), "action", 0, 1),
    (setting(RECORD, "blocks", 0, 3, tick=2), "block", 1, 1),
    (setting(RECORD, "rewards", 1, 1.0000001, tick=2), "own reward", 2, 1),
    (setting(RECORD, "seen_cell", 0, 52, tick=4), "sightings", 3, 1),
    (setting(RECORD, "seen_tick", 0, 4, tick=4), "sightings", 3, 1),
    (setting(RECORD, "version", -1, 9, tick=2), "record", 2, 1),
    (setting("/tmc/sync", "policy", -1, 1, tick=2), "sync reply", 2, -1),
    (setting("/tmc/sync", "uavs", 0, 2, tick=2), "sync reply", 2, -1),
    (setting("/tmc/sync", "version", -1, 4, tick=2), "sync reply", 2, -1),
    (visit_of_cell_4, "map handed out", 2, -1),
    (setting("/tmc/events", "cells", 1, 8), "events", 1, -1),
    (setting("/tmc/metrics", "uncertainty", 0, 0.30000001, first=3), "uncertainty", 3, -1),
    (setting("/tmc/metrics", "reward", 1, 0.0, first=3), "team's reward", 4, -1),
    (setting("/tmc/episode", "reward", 1, 2.5, phase="end"), "end of the episode", 4, -1),
    (setting("/tmc/episode", "starts", 1, 21, phase="begin"), "begin of the episode", 0, -1),
    (setting("/uav/0/observation_hash", "hashes", 1, 1, tick=4), "observation", 3, 0),
]


@pytest.mark.parametrize(("change", "what", "tick", "uav"), CHANGES)
def test_every_change_is_found_where_it_is(
    original: Path, tmp_path: Path, change: Change, what: str, tick: int, uav: int
) -> None:
    other = compare.facts_of(altered(original, tmp_path / "other", change))
    found = compare.first_difference(compare.facts_of(original), other)
    assert found is not None
    assert (found.what, found.episode, found.tick, found.uav) == (what, 1, tick, uav)
    assert found.first != found.second
    assert f"at tick {tick} of episode 1" in str(found)


def test_a_difference_in_words(original: Path, tmp_path: Path) -> None:
    ours = compare.facts_of(original)
    cells = compare.facts_of(altered(original, tmp_path / "cells", setting(RECORD, "cells", 1, 99, tick=2)))
    assert str(compare.first_difference(ours, cells)) == "cell of UAV 1 at tick 2 of episode 1: 22 against 99"
    maps = compare.facts_of(altered(original, tmp_path / "maps", visit_of_cell_4))
    expected = "map handed out at tick 2 of episode 1: cell 4 visited at tick 8 against at tick 9"
    assert str(compare.first_difference(ours, maps)) == expected


def test_what_one_log_lacks_is_a_difference(original: Path, tmp_path: Path) -> None:
    def drop(name: str, message: Any) -> Iterator[Any]:
        if not (name == "/uav/1/observation_hash" and message.tick == 4):
            yield message

    ours, less = compare.facts_of(original), compare.facts_of(altered(original, tmp_path / "less", drop))
    for pair, words in (((ours, less), "102 against nothing"), ((less, ours), "nothing against 102")):
        assert words in str(compare.first_difference(*pair))


def test_what_the_schedule_changes_is_no_fact(original: Path, tmp_path: Path) -> None:
    """Incarnations, waits, how ticks are batched, and repeats of a record."""

    def change(name: str, message: Any) -> Iterator[Any]:
        if name == "/tmc/metrics":
            for k, (uncertainty, reward) in enumerate(zip(message.uncertainty, message.reward, strict=True)):
                yield schemas.TeamMetrics(
                    episode=1, first=message.first + k, uncertainty=[uncertainty], reward=[reward]
                )  # fmt: skip
            return
        if name == RECORD:
            message.incarnation += 1
            yield message
        if name == "/uav/1/status":
            message.waited += 1
        yield message

    ours, other = compare.facts_of(original), compare.facts_of(altered(original, tmp_path / "other", change))
    assert compare.first_difference(ours, other) is None
    assert ours == other


def test_what_the_facts_tell(original: Path) -> None:
    facts = compare.facts_of(original)
    assert compare.moves(facts) == 8
    assert [compare.cell(facts, 1, t, 1) for t in range(5)] == [20, 21, 22, 23, 24]
    kinds = {compare.KINDS[rank] for _, _, rank, _ in facts}
    assert kinds == set(compare.KINDS)


def test_a_log_that_contradicts_itself_is_refused(original: Path, tmp_path: Path) -> None:
    def twice(name: str, message: Any) -> Iterator[Any]:
        yield message
        if name == RECORD and message.tick == 2:
            message.actions[1] = 0
            yield message

    with pytest.raises(RecordError, match="contradicts itself: action of UAV 1 at tick 1 of episode 1: 3 against 0"):
        compare.facts_of(altered(original, tmp_path / "other", twice))


def test_a_damaged_log_is_refused(original: Path, tmp_path: Path) -> None:
    other = altered(original, tmp_path / "other", lambda _name, message: iter([message]))
    path = other / "uav-001.mcap"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(RecordError, match=r"uav-001\.mcap cannot be compared"):
        compare.facts_of(other)
