"""Priorities against a plain list of masses: what is drawn, how often, and what numbers that are gone do to it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmc.center import priorities
from tmc.center.priorities import BLOCK, EPSILON, Priorities, first_errors
from tmc.kernel.draws import Stream, uniforms

ERRORS = st.floats(0, 1e6, width=32)


class Plain:
    """A mass for each number, in a dictionary; nothing is ever summed before it is asked for."""

    def __init__(self, size: int, alpha: float) -> None:
        self.size, self.alpha, self.largest, self.added = size, alpha, 1.0, 0
        self.masses: dict[int, float] = {}

    def add(self, present: list[bool]) -> None:
        for here in present:
            self.masses[self.added] = self.largest**self.alpha if here else 0.0
            self.masses.pop(self.added - self.size, None)
            self.added += 1

    def set(self, numbers: list[int], errors: list[float]) -> None:
        known = [(n, e + EPSILON) for n, e in zip(numbers, errors, strict=True) if self.masses.get(n, 0.0) > 0.0]
        self.largest = max([self.largest, *(p for _, p in known)])
        for n, p in known:
            self.masses[n] = p**self.alpha


def both(size: int, alpha: float) -> tuple[Priorities, Plain]:
    return Priorities(size, alpha), Plain(size, alpha)


def check_masses(mine: Priorities, plain: Plain) -> None:
    numbers = np.array([*plain.masses], np.int64)
    assert mine.mass(numbers) == pytest.approx([*plain.masses.values()], rel=1e-12)
    assert mine.total == pytest.approx(sum(plain.masses.values()), rel=1e-12, abs=0.0)


def check_draw(mine: Priorities, plain: Plain, u: list[float]) -> None:
    """Each number is the one in whose stretch of the total mass (in order of its place) the draw falls."""
    drawn = mine.draw(np.array(u))
    order = sorted(plain.masses, key=lambda n: n % plain.size)
    ends = np.cumsum([plain.masses[n] for n in order])
    slack = 1e-9 * ends[-1]
    for k, n in enumerate(drawn.tolist()):
        assert plain.masses[n] > 0.0
        mass, at = (k + u[k]) / len(u) * ends[-1], order.index(n)
        assert ends[at] - plain.masses[n] - slack <= mass <= ends[at] + slack


@settings(max_examples=80, deadline=None)
@given(st.sampled_from([1, 3, 127, 128, 129, 300]), st.sampled_from([0.3, 0.6, 1.0]), st.data())
def test_any_sequence_of_additions_changes_and_draws(size: int, alpha: float, data: st.DataObject) -> None:
    mine, plain = both(size, alpha)
    for _ in range(data.draw(st.integers(1, 8))):
        present = data.draw(st.lists(st.booleans(), max_size=12)) * data.draw(st.sampled_from([1, 1, 40]))
        mine.add(np.array(present, bool))
        plain.add(present)
        # Numbers that are held, that were, and that are yet to come.
        numbers = data.draw(st.lists(st.integers(0, plain.added + 5), max_size=20, unique=True))
        errors = data.draw(st.lists(ERRORS, min_size=len(numbers), max_size=len(numbers)))
        mine.set(np.array(numbers, np.int64), np.array(errors, "<f4"))
        plain.set(numbers, errors)
        check_masses(mine, plain)
        if mine.total:
            check_draw(mine, plain, data.draw(st.lists(st.floats(0, 1, exclude_max=True), min_size=1, max_size=9)))


def some(size: int, alpha: float = 0.6, added: int = 700) -> tuple[Priorities, Plain]:
    """Errors of all magnitudes, a fifth never to be drawn, the oldest evicted."""
    mine, plain = both(size, alpha)
    rng = np.random.Generator(np.random.Philox(1))
    present, errors = rng.random(added) < 0.8, rng.exponential(size=added).astype("<f4") ** 3
    for memory in (mine, plain):
        memory.add(present if memory is mine else present.tolist())  # type: ignore[arg-type]
    mine.set(np.arange(added), errors)
    plain.set([*range(added)], errors.tolist())
    return mine, plain


@pytest.mark.parametrize("size", [60, 3 * BLOCK + 7])
def test_numbers_are_drawn_in_proportion_to_their_mass(size: int) -> None:
    """Chi-squared over single draws at fixed addresses, so this cannot fail by chance on another day."""
    mine, plain = some(size)
    draws = 6000
    found = [int(mine.draw(uniforms(1, Stream.REPLAY, 1, tick=n))[0]) for n in range(draws)]
    # Those that are seldom drawn are taken together.
    total = sum(plain.masses.values())
    often = {n: draws * mass / total for n, mass in plain.masses.items() if draws * mass / total >= 5}
    expected = [*often.values(), draws - sum(often.values())]
    counts = [found.count(n) for n in often]
    counts.append(draws - sum(counts))
    chi2 = sum((c - e) ** 2 / e for c, e in zip(counts, expected, strict=True))
    freedom = len(expected) - 1
    assert freedom > 20 and abs(chi2 - freedom) < 3 * (2 * freedom) ** 0.5


def test_a_minibatch_is_spread_evenly_over_the_mass() -> None:
    """With B shares, a transition with the mass of B P(i) shares is drawn that often, to within one share at either
    end.
    """
    mine, plain = some(200)
    total = sum(plain.masses.values())
    for number in range(20):
        drawn = mine.draw(uniforms(2, Stream.REPLAY, 64, tick=number)).tolist()
        for n, mass in plain.masses.items():
            assert abs(drawn.count(n) - 64 * mass / total) < 2


@pytest.mark.parametrize("edge", [0.0, np.nextafter(1.0, 0.0)])
def test_draws_at_the_edges_of_shares_find_somebody(edge: float) -> None:
    mine, plain = both(4 * BLOCK, 1.0)
    present = [False] * BLOCK + [False, True] * (BLOCK // 2) + [False] * (2 * BLOCK)
    mine.add(np.array(present))
    plain.add(present)
    mine.set(np.arange(mine.added), np.full(mine.added, 0.1, "<f4"))
    drawn = mine.draw(np.full(333, edge))
    assert all(plain.masses[n] > 0.0 for n in drawn.tolist())


def test_who_was_never_judged_has_the_largest_priority_so_far() -> None:
    mine = Priorities(10, 0.5)
    mine.add(np.array([True, True, False]))
    assert mine.mass(np.arange(3)).tolist() == [1.0, 1.0, 0.0]
    mine.set(np.array([0, 2]), np.array([8.999, 1e9], "<f4"))  # the second one is never drawn, and does not count
    mine.add(np.array([True]))
    mine.set(np.array([0]), np.array([0.0], "<f4"))
    mine.add(np.array([True]))
    assert mine.mass(np.arange(5)) == pytest.approx([EPSILON**0.5, 1.0, 0.0, 3.0, 3.0])


def test_numbers_that_are_gone_or_to_come_change_nothing() -> None:
    mine, plain = some(100, added=150)
    before = mine.draw(np.linspace(0, 0.9, 50)).tolist()
    mine.set(np.array([-1, 0, 49, 150, 250, 2**40]), np.full(6, 1e6, "<f4"))
    check_masses(mine, plain)
    assert mine.draw(np.linspace(0, 0.9, 50)).tolist() == before


@pytest.mark.parametrize("beta", [0.0, 0.4, 1.0])
def test_weights_are_those_of_the_paper(beta: float) -> None:
    """(N P(i))^-beta over the largest of the minibatch; with beta = 1 as if all were drawn equally often."""
    mine, plain = some(300)
    numbers = mine.draw(uniforms(1, Stream.REPLAY, 32))
    total, held = sum(plain.masses.values()), len(plain.masses)
    raw = np.array([(held * plain.masses[n] / total) ** -beta for n in numbers.tolist()])
    weight = mine.weights(numbers, beta)
    assert weight.dtype == np.float32 and weight.max() == 1.0
    assert weight == pytest.approx(raw / raw.max(), rel=1e-6)


def test_sums_do_not_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    """A large priority that comes and goes leaves the sum of its block as it was, to the last bit."""
    mine, _ = some(200)
    before = mine.total
    mass = mine.mass(np.array([550]))
    for _ in range(1000):
        mine.set(np.array([550]), np.array([1e30], "<f4"))
    monkeypatch.setattr(priorities, "EPSILON", 0.0)
    mine.set(np.array([550]), mass ** (1 / 0.6))
    assert mine.total == pytest.approx(before, rel=1e-14)


def test_first_errors_by_hand() -> None:
    nan = float("nan")
    values: Any = np.array([[[1.0, 2.0], [5.0, 5.0], [nan, nan]]], "<f4")
    following: Any = np.array([[[0.0, 3.0], [nan, nan], [1.0, 1.0]]], "<f4")
    found = first_errors(np.array([[0.5, 1.0, 1.0]]), values, 0.9, following)
    assert found[0, 0] == pytest.approx(abs(0.5 + 0.9 * 3.0 - 1.0)) and np.isnan(found[0, 1:]).all()
