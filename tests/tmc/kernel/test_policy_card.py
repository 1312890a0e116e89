"""The description inside a policy file: it survives its JSON, and a policy flies only where it fits."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmc.kernel.config import Config, build
from tmc.kernel.grid import Grid
from tmc.kernel.policy import FORMAT, PolicyCard, PolicyError, card_for, require, view_shape

QUICK = settings(max_examples=50, deadline=None)

GRID = Grid(30, 30)
EGO = {"observation.view": "ego", "observation.radius": 8, "observation.near": 2, "exploration.mask_blocked": True}
CONFIGS = {"paper": build({}), "ego": build(EGO), "scenario-1": build({"scenario": 1})}


@pytest.fixture(params=CONFIGS)
def config(request: pytest.FixtureRequest) -> Config:
    return CONFIGS[request.param]


def test_card_goes_through_its_json(config: Config) -> None:
    card = card_for(config, GRID, 7, 1234)
    assert PolicyCard.from_json(card.to_json()) == card
    assert (card.version, card.updates, card.format) == (7, 1234, FORMAT)


def test_the_papers_card() -> None:
    """Input 30 x 30 x 3 (Sec. IV-B), nine actions (Sec. III-B)."""
    card = card_for(build({}), GRID, 0, 0)
    assert (card.channels, card.height, card.width, card.actions) == (3, 30, 30, 9)
    assert (card.view, card.near, card.mask_blocked, card.scenario) == ("whole", 0, False, 2)


@pytest.mark.parametrize(
    ("settings", "shape"),
    [({}, (3, 5, 7)), ({"observation.view": "ego", "observation.radius": 1}, (3, 3, 3)), (EGO, (3, 17, 17))],
)
def test_shape_of_the_view(settings: dict[str, Any], shape: tuple[int, int, int]) -> None:
    assert view_shape(build(settings), Grid(5, 7)) == shape


def test_a_policy_flies_where_it_was_trained(config: Config) -> None:
    require(card_for(config, GRID, 1, 1), config, GRID)


def test_an_egocentric_policy_flies_on_any_map() -> None:
    require(card_for(CONFIGS["ego"], GRID, 1, 1), CONFIGS["ego"], Grid(12, 40))


def test_a_policy_for_another_view_or_map_is_refused() -> None:
    card = card_for(CONFIGS["paper"], GRID, 1, 1)
    with pytest.raises(
        PolicyError, match=r"made for whole view, 3 channels of 30 x 30 cells, this mission has ego view"
    ):
        require(card, CONFIGS["ego"], GRID)
    with pytest.raises(PolicyError, match="12 x 40 cells: choose the map it was trained on"):
        require(card, CONFIGS["paper"], Grid(12, 40))
    same_shape = build({"observation.view": "ego", "observation.radius": 8})
    with pytest.raises(PolicyError, match="ego view"):
        require(card_for(build({}), Grid(17, 17), 1, 1), same_shape, Grid(17, 17))


@pytest.mark.parametrize(("field", "value"), [("actions", 5), ("channels", 4), ("height", 29), ("width", 31)])
def test_a_policy_of_another_shape_is_refused(field: str, value: int, config: Config) -> None:
    card = dataclasses.replace(card_for(config, GRID, 1, 1), **{field: value})
    with pytest.raises(PolicyError):
        require(card, config, GRID)


@QUICK
@given(st.text(max_size=50))
def test_text_that_is_no_card_is_refused(text: str) -> None:
    with pytest.raises(PolicyError):
        PolicyCard.from_json(text)


@pytest.mark.parametrize(
    "text",
    [
        "[]", "{}", "null", "7", "NaN", '"overfly"',
        pytest.param("[" * 5000, id="nested lists"), pytest.param('{"a":' * 5000, id="nested maps"),
        json.dumps({**dataclasses.asdict(card_for(build({}), GRID, 1, 1)), "colour": "red"}),
        json.dumps({k: v for k, v in dataclasses.asdict(card_for(build({}), GRID, 1, 1)).items() if k != "view"}),
    ],
)  # fmt: skip
def test_descriptions_that_are_none_are_refused_in_one_sentence(text: str) -> None:
    with pytest.raises(PolicyError, match="the file is not an Overfly policy") as caught:
        PolicyCard.from_json(text)
    assert "\n" not in str(caught.value)


def test_a_card_of_another_format_is_refused() -> None:
    newer = dataclasses.replace(card_for(build({}), GRID, 1, 1), format=FORMAT + 1)
    with pytest.raises(PolicyError, match=rf"has format {FORMAT + 1}, this Overfly reads format {FORMAT}"):
        PolicyCard.from_json(newer.to_json())
