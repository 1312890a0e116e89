"""What a mission will send is compared with the rules of the messages before it starts; no number is repeated."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from deploy.run.supervisor import FINAL
from learner.trainer import Trainer
from tmc.kernel.config import MAX_SIGHTINGS, ConfigError, build, flat
from tmc.kernel.grid import Grid
from tmc.kernel.policy import PolicyError, policy_bytes, view_shape
from tmc.kernel.roadmap import parse_raster
from tmc.kernel.world import World
from tmc.wire import capacity, fields, process
from tmc.wire import messages as m


def world_of(raster: str = "####\n#..#\n####\n", **values: Any) -> World:
    return World(build({"team.size": 2, **values}), parse_raster(raster))


def refused(world: World) -> str:
    with pytest.raises(ConfigError) as error:
        capacity.check(world, learning=True)
    text = str(error.value)
    assert text.isprintable() and len(text) < 300
    return text


SETTINGS: list[dict[str, Any]] = [
    {}, {"network.channels": (4,), "network.kernel": 3}, {"network.dense": 300, "observation.view": "ego"},
    {"observation.view": "ego", "observation.near": 2}, {"network.channels": (8,) * 12, "network.kernel": 1},
]  # fmt: skip


@pytest.mark.parametrize("values", SETTINGS)
def test_a_policy_is_as_large_as_its_settings_say(values: dict[str, Any]) -> None:
    """Never larger, or a mission that was let through would fail; and not smaller by more than what names its parts."""
    config, grid = build({"network.stride": 1, **values}), Grid(12, 13)
    made = len(Trainer(config, view_shape(config, grid), grid).policy()[1])
    layers = len(config.network.channels) + 3
    assert made <= policy_bytes(config, view_shape(config, grid)) <= made + 1024 * layers


def test_a_network_that_makes_policies_too_large_is_refused() -> None:
    limit = int(fields.rules(m.PolicyPush)["model"].high)
    config = build({"network.channels": (4,), "network.kernel": 3, "network.stride": 1})
    side, dense = 60, 1
    raster = "\n".join(["#" * side] * side)
    while policy_bytes(build({"network.dense": dense}, config), (3, side, side)) <= limit:
        dense *= 2
    world = World(build({"network.dense": dense}, config), parse_raster(raster))
    assert f"network.dense = {dense}" in refused(world) and f"PolicyPush.model takes {limit:,}" in refused(world)
    capacity.check(World(build({"network.dense": dense // 2}, config), world.map), learning=True)
    capacity.check(world, learning=False)


def test_settings_whose_text_is_too_long_are_refused() -> None:
    limit = int(fields.rules(m.Welcome)["config"].high)
    world = world_of(**{"network.kernel": 1, "network.stride": 1, "network.channels": (1,) * (limit // 3)})
    assert len(json.dumps(flat(world.config))) > limit
    assert "shorten network.channels" in refused(world)


def test_a_minibatch_that_no_frame_takes_is_refused_and_the_fix_that_is_named_is_one() -> None:
    raster = "\n".join(["#" * 60] * 60)
    text = refused(world_of(raster, **{"dqn.batch_size": 60_000}))
    most = int(text.rpartition("choose ")[2].partition(" or less")[0])
    capacity.check(world_of(raster, **{"dqn.batch_size": most}), learning=True)
    refused(world_of(raster, **{"dqn.batch_size": most + 1}))


def test_every_field_that_settings_fill_is_held_to_its_rule() -> None:
    world = world_of(**{"network.kernel": 1})
    needs = list(capacity.needs(world, learning=True))
    assert all(need.limit == fields.rules(need.message)[need.field].high for need in needs)
    assert {need.message for need in needs} >= {m.Welcome, m.Begin, m.Map, m.Record, m.PolicyPush, m.Minibatch}
    assert {fields.rules(m.Record)[name].high for name in ("seen_cell", "seen_tick")} == {MAX_SIGHTINGS}


@pytest.mark.parametrize("change", [lambda limit: limit, lambda limit: limit + 1], ids=["the largest", "one more"])
def test_a_policy_file_is_held_to_the_rule(change: Callable[[int], int]) -> None:
    limit = int(fields.rules(m.Policy)["model"].high)
    size = change(limit)
    if size == limit:
        capacity.check_policy(size)
    else:
        with pytest.raises(PolicyError, match="a policy may have"):
            capacity.check_policy(size)


def test_a_message_that_breaks_its_rule_all_the_same_ends_a_process_with_a_sentence() -> None:
    """With an exit code after which it is not started again."""
    import actors.__main__ as uav  # noqa: PLC0415  each sets its own environment
    import learner.__main__ as learner  # noqa: PLC0415
    import tmc.__main__ as center  # noqa: PLC0415

    def push() -> int:
        m.Bye("uav", 0, "x" * 1025)
        return 0

    for process_of in (uav, learner, center):
        assert process.run(push, process_of.MISTAKES) == process.USAGE
    assert process.USAGE in FINAL
