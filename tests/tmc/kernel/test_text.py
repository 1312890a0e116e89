"""Words of others: made fit to be shown, and compared with the names that exist."""

from __future__ import annotations

import pytest

from tmc.kernel.text import nearest, suggestion

NAMES = ("run", "fly", "evaluate", "doctor")


@pytest.mark.parametrize(
    ("name", "near"),
    [("fyl", "fly"), ("evalute", "evaluate"), ("Doctor", "doctor"), ("RUN", "run"), ("zzz", ""), ("", "")],
)
def test_the_most_similar_name_is_found_whatever_its_case(name: str, near: str) -> None:
    assert nearest(name, NAMES) == near


def test_a_suggestion_is_the_nearest_name_or_all_of_them() -> None:
    assert suggestion("evalute", NAMES) == "did you mean evaluate?"
    assert suggestion("zzz", iter(NAMES)) == "choose run, fly, evaluate, doctor"
