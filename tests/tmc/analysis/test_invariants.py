"""No fact of a journal can be changed, left out or repeated without violating an invariant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from tmc.analysis.invariants.check import INVARIANTS
from tmc.analysis.invariants.episode_log import EpisodeCollector
from tmc.analysis.invariants.recompute import truth
from tmc.analysis.run_config import world_of
from tmc.kernel.world import World
from tmc.record.reader import Log, LogMessage

Fly = Callable[..., Path]
MISSIONS: list[dict[str, object]] = [
    {"team.size": 5, "training.ticks": 20, "training.episodes": 2, "world.start": "road"},
    {"team.size": 5, "training.ticks": 15, "training.episodes": 2, "scenario": 1},
    {"team.size": 5, "training.ticks": 20, "comms.period": 7, "comms.phase": "staggered", "reward.uncertainty": "own"},
]
NO_FACTS = frozenset((
    "incarnation", "policy", "updates", "epsilon", "elapsed",  # how the flight came about
    "timestamp", "frame_id", "pose", "cell_size", "fields",  # how a map is drawn
))  # fmt: skip
TOPICS = ("/uav/", "/tmc/sync", "/tmc/episode", "/tmc/events", "/tmc/metrics", "/tmc/last_visit")
"""The topics that are checked. The digests of `/tmc/state` are checked by replaying the journal."""
FLOATS = (1, 2)
"""Kinds of protobuf fields: double and float."""


def violated(world: World, entries: list[LogMessage]) -> set[str]:
    """The invariants that do not hold."""
    found = set()
    for e in EpisodeCollector(world).episodes(entries):
        reference = truth(e)
        found |= {name for name, _, invariant in INVARIANTS if invariant(e, reference).violation}
    return found


@cache
def journal(folder: Path) -> tuple[World, list[LogMessage]]:
    world, _ = world_of(folder, folder / "tmc.mcap")
    entries = [e for e in Log(folder / "tmc.mcap").entries() if e.topic.startswith(TOPICS)]
    assert violated(world, entries) == set()
    return world, entries


def other(value: Any, kind: int, draw: Callable[..., Any]) -> Any:
    """Another value for a field or an entry of it."""
    if kind in FLOATS:
        return value + draw(st.sampled_from([-3.0, -0.01, 0.01, 0.5, float("nan")]))
    if isinstance(value, str):
        return "end" if value == "begin" else "begin"
    return draw(st.sampled_from([value + 1, max(value - 1, 0), 0, 700, 2**32 - 1]))


def alter(message: Any, draw: Callable[..., Any]) -> Any:
    """The message with one fact changed, one more or one less."""
    changed = type(message)()
    changed.CopyFrom(message)
    field = draw(st.sampled_from([f for f in message.DESCRIPTOR.fields if f.name not in NO_FACTS]))
    values = getattr(changed, field.name)
    if isinstance(values, bytes):
        at, bit = draw(st.integers(0, len(values) - 1)), 1 << draw(st.integers(0, 7))
        setattr(changed, field.name, values[:at] + bytes([values[at] ^ bit]) + values[at + 1 :])
    elif not hasattr(values, "append"):
        setattr(changed, field.name, other(values, field.type, draw))
    elif not values or draw(st.booleans()):
        values.append(draw(st.sampled_from([0.25, 7.5] if field.type in FLOATS else [0, 1, 7, 2**31])))
    else:
        at = draw(st.integers(0, len(values) - 1))
        new = [] if draw(st.booleans()) else [other(values[at], field.type, draw)]
        values[:] = [*values[:at], *new, *values[at + 1 :]]
    return changed


@pytest.mark.parametrize("mission", MISSIONS, ids=str)
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(data=st.data())
def test_no_change_of_a_fact_goes_unnoticed(fly: Fly, mission: dict[str, object], data: st.DataObject) -> None:
    world, entries = journal(fly(**mission))
    at = data.draw(st.integers(0, len(entries) - 1), label="message")
    what = data.draw(st.sampled_from(["changed", "changed", "changed", "left out", "told twice"]))
    entry = entries[at]
    assume(what != "left out" or at < len(entries) - 1)  # without its end the journal is just not finished
    assume(what != "told twice" or entry.topic != "/tmc/episode" or entry.message.phase == "end")
    told = {"left out": [], "told twice": [entry, entry]}.get(what, [])
    if what == "changed":
        told = [replace(entry, message=alter(entry.message, data.draw))]
        assume(told[0].message != entry.message)
    assert violated(world, [*entries[:at], *told, *entries[at + 1 :]])
