"""Addressed randomness: the stream's golden values, its independence of everything but the address, and `distinct`."""

from __future__ import annotations

from itertools import permutations, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmc.kernel.draws import Stream, distinct, uniforms

QUICK = settings(max_examples=50, deadline=None)

ADDRESS = st.fixed_dictionaries({
    "seed": st.integers(0, 2**63 - 1),
    "stream": st.sampled_from(Stream),
    "episode": st.integers(0, 2**31 - 1),
    "tick": st.integers(0, 65_535),
    "uav": st.integers(0, 65_535),
})  # fmt: skip


def draw(address: dict[str, Any], n: int = 4) -> list[float]:
    """`n` numbers at an address given as a dictionary."""
    return uniforms(
        address["seed"], address["stream"], n, **{k: address[k] for k in ("episode", "tick", "uav")}
    ).tolist()


@pytest.mark.parametrize(
    ("seed", "stream", "address", "golden"),
    [
        (1, Stream.STARTS, {}, ["0x1.33d1b1836b498p-4", "0x1.f7b3fee892664p-1", "0x1.e51363729df3cp-1"]),
        (
            1,
            Stream.EVENTS,
            {"episode": 2, "tick": 3, "uav": 4},
            ["0x1.92b4b2a7e8665p-1", "0x1.dedeca4f0d2acp-3", "0x1.af55ed65e56d2p-1"],
        ),
        (
            2**63 - 1,
            Stream.REPLAY,
            {"episode": 2**31 - 1, "tick": 65_535, "uav": 65_534},
            ["0x1.c5829bce999fep-2", "0x1.3a81c9f01b9d8p-2", "0x1.8ab547b948baep-1"],
        ),
    ],
)
def test_golden_values(seed: int, stream: Stream, address: dict[str, int], golden: list[str]) -> None:
    """Every log and every test of a mission stands on these bits: a NumPy that draws others must be noticed."""
    assert [x.hex() for x in uniforms(seed, stream, 3, **address).tolist()] == golden


def test_stream_numbers_are_for_ever() -> None:
    """They are part of the address, so a new number would change every mission that was ever logged."""
    assert {s.name: s.value for s in Stream} == {
        "STARTS": 1, "AGES": 2, "EVENTS": 3, "EXPLORATION": 4, "PLANNER": 5, "REPLAY": 6, "WEIGHTS": 7, "STALLS": 8,
    }  # fmt: skip


@QUICK
@given(ADDRESS)
def test_same_address_draws_the_same(address: dict[str, Any]) -> None:
    """Whatever was drawn before, here or anywhere, and however much of it."""
    first = draw(address)
    np.random.default_rng().random(3)
    draw({**address, "tick": address["tick"] ^ 1}, 1000)
    assert draw(address) == first


@QUICK
@given(ADDRESS, st.sampled_from(["seed", "stream", "episode", "tick", "uav"]), st.data())
def test_each_part_of_the_address_counts(address: dict[str, Any], part: str, data: st.DataObject) -> None:
    strategy = st.sampled_from(Stream) if part == "stream" else st.integers(0, 65_535)
    other = data.draw(strategy.filter(lambda value: value != address[part]))
    assert not set(draw(address)) & set(draw({**address, part: other}))


@QUICK
@given(st.integers(0, 65_535), st.integers(0, 65_535).filter(bool))
def test_parts_of_the_address_do_not_stand_in_for_each_other(a: int, b: int) -> None:
    """Tick a of UAV b is not UAV a at tick b, and so on for each pair of parts."""
    names = ("episode", "tick", "uav")
    drawn = [uniforms(1, Stream.EVENTS, 2, **{x: a, y: b}).tobytes() for x, y in permutations(names, 2)]
    assert len(set(drawn)) == (6 if a not in {0, b} else 3)


def test_neighbouring_addresses_never_overlap() -> None:
    """The words of an address are its own, however many are drawn: no run of one appears in the next."""
    base = uniforms(1, Stream.EXPLORATION, 20_000)
    for address in ({"tick": 1}, {"uav": 1}, {"episode": 1}):
        assert not np.isin(uniforms(1, Stream.EXPLORATION, 20_000, **address), base).any()


@QUICK
@given(ADDRESS, st.integers(0, 40), st.integers(0, 40))
def test_asking_for_more_does_not_change_the_first(address: dict[str, Any], few: int, more: int) -> None:
    assert draw(address, few + more)[:few] == draw(address, few)


@QUICK
@given(ADDRESS)
def test_draws_are_floats_below_one(address: dict[str, Any]) -> None:
    u = uniforms(address["seed"], address["stream"], 100)
    assert u.dtype == np.float64
    assert u.shape == (100,)
    assert ((u >= 0) & (u < 1)).all()
    assert (u * 2.0**53 % 1 == 0).all(), "53 random bits each"


@pytest.mark.parametrize("stream", Stream)
def test_draws_are_uniform(stream: Stream) -> None:
    """64 bins of 1,000 each: chi-square with 63 degrees of freedom, mean 63, deviation 11.2; fixed seed."""
    counts = np.bincount((uniforms(11, stream, 64_000) * 64).astype(int), minlength=64)
    assert 63 - 4 * 11.2 < ((counts - 1000) ** 2 / 1000).sum() < 63 + 4 * 11.2


def test_draws_of_one_tick_after_the_other_are_uncorrelated() -> None:
    """One draw at each of 10,000 addresses is as random as 10,000 draws at one."""
    u = np.array([uniforms(3, Stream.EVENTS, 1, tick=t)[0] for t in range(10_000)])
    assert abs(u.mean() - 0.5) < 4 / np.sqrt(12 * u.size)
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 4 / np.sqrt(u.size)


def test_distinct_gives_every_selection_equally_often() -> None:
    """Exact: over a grid of uniforms that hits each branch equally often, all ordered pairs of four appear 12 times."""
    mids = (np.arange(12) + 0.5) / 12
    pairs = [tuple(distinct(np.array(u), np.array([5, 7, 11, 13]), 2)) for u in product(mids, mids)]
    assert {pair: pairs.count(pair) for pair in set(pairs)} == dict.fromkeys(permutations((5, 7, 11, 13), 2), 12)


def test_distinct_is_uniform_over_addresses() -> None:
    """2,000 starts of 3 out of 20: each cell is drawn 300 times, give or take 5 deviations of 16."""
    candidates = np.arange(20)
    counts = np.zeros(20, int)
    for episode in range(2000):
        counts[distinct(uniforms(1, Stream.STARTS, 3, episode=episode), candidates, 3)] += 1
    assert np.abs(counts - 300).max() < 5 * np.sqrt(2000 * 0.15 * 0.85)


@QUICK
@given(st.lists(st.integers(0, 65_534), unique=True, min_size=1, max_size=60), st.data())
def test_distinct_never_repeats_or_invents(candidates: list[int], data: st.DataObject) -> None:
    n = data.draw(st.integers(0, len(candidates)))
    u = data.draw(st.lists(st.floats(0, 1, exclude_max=True), min_size=n, max_size=n))
    before = np.array(candidates, np.int64)
    chosen = distinct(np.array(u), before, n)
    assert len(chosen) == len(set(chosen)) == n
    assert set(chosen) <= set(candidates)
    assert before.tolist() == candidates, "the candidates are left as they were"
    assert all(type(k) is int for k in chosen)


@QUICK
@given(st.integers(1, 65_535))
def test_distinct_takes_the_largest_draw(size: int) -> None:
    """The largest number below one must not round up to an index behind the last."""
    top = np.full(1, 1.0 - 2.0**-53)
    assert distinct(top, np.arange(size), 1) == [size - 1]
