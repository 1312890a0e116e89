"""A policy file flies only where it can, and chooses the best action that it may."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from actors.planners import LocalState
from actors.policy import PolicyController, read_card
from learner import qnet
from learner.export import to_onnx
from tmc.kernel.config import Config, build
from tmc.kernel.grid import Grid
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.policy import KEY, FlightError, PolicyCard, PolicyError, card_for, view_shape
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World

TINY: dict[str, Any] = {
    "observation.view": "ego", "observation.radius": 4, "network.channels": (2,), "network.kernel": 3,
    "network.dense": 4, "team.size": 2,
}  # fmt: skip


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def policy(config: Config, grid: Grid, change: Callable[[Any], None] = lambda net: None, **card: Any) -> bytes:
    """Return a policy for these settings, with changes to its network and to its card."""
    net = qnet.build(config, view_shape(config, grid))
    with torch.no_grad():
        change(net)
    return to_onnx(net, dataclasses.replace(card_for(config, grid, 7, 100), **card))


@pytest.fixture
def world(town: RoadMap) -> World:
    return World(build(TINY), town)


def refused(model: bytes, world: World) -> str:
    """Return the sentence of the refusal."""
    with pytest.raises(PolicyError) as error:
        PolicyController(model, world.config, ObservationBuilder(world))
    text = str(error.value)
    assert "\n" not in text and 20 < len(text) < 200
    assert error.value.__cause__ is None and error.value.__suppress_context__ | (error.value.__context__ is None)
    return text


def state(world: World, cell: int, peers: list[int], seed: int = 0) -> LocalState:
    u = np.random.Generator(np.random.Philox(seed)).random(world.law.cells.size)
    return LocalState(0, cell, cell, peers, u, ObservationBuilder(world).allowed(cell, peers), 0.0)


@pytest.mark.parametrize("mask", [False, True])
@pytest.mark.parametrize("view", ["ego", "whole"])
def test_it_chooses_what_the_network_values_most(town: RoadMap, mask: bool, view: str) -> None:
    config = build({**TINY, "exploration.mask_blocked": mask, "observation.view": view})
    world = World(config, town)
    net = qnet.build(config, view_shape(config, world.grid))
    with torch.no_grad():
        net.out.weight.normal_(generator=torch.Generator().manual_seed(5))
    observer = ObservationBuilder(world)
    controller = PolicyController(to_onnx(net, card_for(config, world.grid, 1, 0)), config, observer)
    chosen = set()
    for seed, cell in enumerate(world.start_cells.tolist()):
        peers = [k for k in world.grid.target_lists[cell][:8] if k >= 0 and not town.blocked[k]][: seed % 4]
        s = state(world, cell, peers, seed)
        o = observer.observe(cell, peers, s.u)
        q = net(torch.tensor(o[None])).detach().numpy()[0]
        may = s.allowed if mask else range(9)
        assert controller.choose(s) in [a for a in may if q[a] >= max(q[b] for b in may) - 1e-5]  # but for rounding
        chosen.add(controller.choose(s))
    assert len(chosen) > 1


@pytest.mark.parametrize("mask", [False, True])
def test_it_knows_what_actions_are_worth(town: RoadMap, mask: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of what it chose by and of what it did not look at yet; the network runs once a state."""
    config = build({**TINY, "exploration.mask_blocked": mask})
    world = World(config, town)
    net = qnet.build(config, view_shape(config, world.grid))
    with torch.no_grad():
        net.out.weight.normal_(generator=torch.Generator().manual_seed(5))
    observer, runs = ObservationBuilder(world), [0]
    controller = PolicyController(to_onnx(net, card_for(config, world.grid, 1, 0)), config, observer)
    q_values = controller.q_values

    def counted() -> Any:
        runs[0] += 1
        return q_values()

    monkeypatch.setattr(controller, "q_values", counted)
    cells = world.start_cells.tolist()[:12]
    for seed, cell in enumerate(cells):
        s = state(world, cell, [k for k in world.grid.target_lists[cell][:2] if k >= 0], seed)
        o = observer.observe(cell, s.peers, s.u)
        q = net(torch.tensor(o[None])).detach().numpy()[0]
        best = max(q[a] for a in (s.allowed if mask else range(9)))
        chosen = controller.choose(s) if seed % 2 else None  # it does not look where exploration chose
        for action in range(9):
            assert controller.q_of(s, action) == (pytest.approx(q[action], abs=1e-5), pytest.approx(best, abs=1e-5))
        if chosen is not None:
            assert controller.q_of(s, chosen)[0] == controller.q_of(s, chosen)[1]
    assert runs == [len(cells)]


@pytest.mark.parametrize("favourite", range(9))
def test_the_mask_takes_the_next_best(town: RoadMap, favourite: int) -> None:
    """In the north-west corner, with a peer in the east: N, W, NW, NE, SW lead off the grid, E is held."""

    def likes(net: Any) -> None:
        net.out.weight.zero_()
        net.out.bias.copy_(torch.tensor([10.0 if a == favourite else -float(a) for a in range(9)]))

    for mask in (False, True):
        config = build({**TINY, "exploration.mask_blocked": mask})
        world = World(config, town)
        controller = PolicyController(policy(config, world.grid, likes), config, ObservationBuilder(world))
        s = state(world, 0, [1])
        assert s.allowed == [1, 7, 8]
        expected = favourite if not mask or favourite in s.allowed else 1
        assert controller.choose(s) == expected


def test_the_card_comes_back(world: World) -> None:
    assert read_card(policy(world.config, world.grid)) == card_for(world.config, world.grid, 7, 100)


@pytest.mark.parametrize(
    ("values", "shape"),
    [
        ({"observation.radius": 5}, "3 channels of 11 x 11"),
        ({"observation.view": "whole"}, "whole view, 3 channels of 30 x 30"),
    ],
)
def test_a_policy_for_another_view_is_refused(world: World, values: dict[str, Any], shape: str) -> None:
    other = build({**TINY, **values})
    text = refused(policy(other, Grid(30, 30)), world)
    assert shape in text and "this mission has ego view, 3 channels of 9 x 9 cells" in text


def test_a_policy_for_another_grid_is_refused(town: RoadMap) -> None:
    config = build({**TINY, "observation.view": "whole"})
    text = refused(policy(config, Grid(30, 30)), World(config, town))
    assert "30 x 30" in text and "9 x 12" in text and "choose the map it was trained on" in text


def test_a_policy_with_other_channels_or_actions_is_refused(world: World) -> None:
    assert "4 channels" in refused(policy(world.config, world.grid, channels=4), world)
    assert "5 actions" in refused(policy(world.config, world.grid, actions=5), world)
    assert "format 2" in refused(policy(world.config, world.grid, format=2), world)


def test_a_network_that_breaks_its_promise_is_refused(world: World) -> None:
    """The description fits, the graph does not."""
    other = build({**TINY, "observation.radius": 6})
    lie = dataclasses.asdict(card_for(world.config, world.grid, 1, 0))
    text = refused(policy(other, world.grid, **lie), world)
    assert text == "the model's 'observation' has the shape [any, 3, 13, 13]: it must be [1, 3, 9, 9]"


PARAMETERS = ["convs.0.weight", "convs.0.bias", "dense.weight", "dense.bias", "out.weight", "out.bias"]


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", PARAMETERS)
def test_weights_that_are_not_finite_do_not_fly(world: World, name: str, bad: float) -> None:
    """Wherever they stand, one of them is enough; it shows in flight, where the values are used."""

    def spoil(net: Any) -> None:
        dict(net.named_parameters())[name].reshape(-1)[0] = bad

    controller = PolicyController(policy(world.config, world.grid, spoil), world.config, ObservationBuilder(world))
    with pytest.raises(FlightError, match="gave values that are not finite"):
        controller.choose(state(world, int(world.start_cells[0]), []))


@pytest.mark.parametrize("junk", [b"", b"garbage", b"\x00" * 100, b"\x08\x09\x12", bytes(range(256)) * 20])
def test_bytes_that_are_no_model_are_refused(world: World, junk: bytes) -> None:
    assert "ONNX" in refused(junk, world) or not junk
    whole = policy(world.config, world.grid)
    refused(whole[: len(whole) // 2], world)


@pytest.mark.parametrize("text", [None, "", "{}", "[1]", "null", "{", '{"channels": 3}'])
def test_a_model_without_a_description_is_refused(world: World, text: str | None) -> None:
    model = onnx.load_from_string(policy(world.config, world.grid))
    del model.metadata_props[:]
    if text is not None:
        onnx.helper.set_model_props(model, {KEY: text})
    assert "not an Overfly policy" in refused(model.SerializeToString(), world)


def test_a_model_with_other_names_is_refused(world: World) -> None:
    """A foreign network under our description."""
    model = onnx.load_from_string(policy(world.config, world.grid))
    for node in model.graph.node:
        node.output[:] = ["other" if name == "q" else name for name in node.output]
    model.graph.output[0].name = "other"
    refused(model.SerializeToString(), world)


def test_a_description_is_read_or_refused_in_one_sentence() -> None:
    card = PolicyCard(3, 9, 9, 9, "ego", 4, 0, False, 2, 1, 0)
    assert PolicyCard.from_json(card.to_json()) == card
