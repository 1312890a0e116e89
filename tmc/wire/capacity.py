"""Check before a mission starts that its messages fit the limits of their fields."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tmc.kernel.config import ConfigError, flat
from tmc.kernel.policy import PolicyError, policy_bytes, view_shape
from tmc.wire import fields
from tmc.wire import messages as m

if TYPE_CHECKING:
    from tmc.kernel.world import World


@dataclass(frozen=True)
class Need:
    """The largest size of a field in a mission: `size` in `unit`, its cause, and the fix."""

    message: type[m.Message]
    field: str
    size: int
    unit: str
    cause: str
    fix: str

    @property
    def limit(self) -> int:
        """The largest size that the field accepts."""
        return int(fields.rules(self.message)[self.field].high)


def needs(world: World, *, learning: bool) -> Iterator[Need]:
    """Yield the fields whose size depends on settings and map.

    Sightings of a record are checked with the settings (`tmc.kernel.config`), since they occur in every mission.
    """
    config, cells, ticks = world.config, world.law.cells.size, world.config.training.ticks + 1
    texts = {key: len(json.dumps(value)) for key, value in flat(config).items()}
    longest = max(texts, key=texts.__getitem__)
    yield Need(
        m.Welcome,
        "config",
        len(json.dumps(flat(config))),
        "characters",
        "the text of all settings",
        f"shorten {longest}",
    )
    of_cells: tuple[tuple[type[m.Message], str], ...] = (
        (m.Begin, "last_visit"),
        (m.Map, "last_visit"),
        (m.Map, "active"),
    )
    for message, name in of_cells:
        yield Need(message, name, cells, "cells", f"the monitored cells of {world.map.name}", "make the cells wider")
    of_ticks: tuple[tuple[type[m.Message], str], ...] = ((m.Begin, "track"), (m.Record, "cells"), (m.Beacon, "cells"))
    for message, name in of_ticks:
        yield Need(message, name, ticks, "ticks", "an episode with its start", "lower training.ticks")
    if learning:
        yield from _of_learning(world)


def _of_learning(world: World) -> Iterator[Need]:
    """Yield the fields of messages between learner and TMC."""
    config, batch, network = world.config, world.config.dqn.batch_size, world.config.network
    size = policy_bytes(config, view_shape(config, world.grid))
    cause = f"a policy with network.dense = {network.dense} and network.channels = {list(network.channels)[:8]}"
    yield Need(m.PolicyPush, "model", size, "bytes", cause, "lower these, or raise network.stride")
    yield Need(m.SampleRequest, "index", batch, "transitions", "dqn.batch_size", "lower it")
    for name, width in (("u", world.law.cells.size), ("peers", max(config.team.size - 1, 1))):
        most = int(fields.rules(m.Minibatch)[name].high) // (2 * width)
        cause = f"a minibatch of dqn.batch_size = {batch}"
        yield Need(m.Minibatch, name, 2 * batch * width, "values", cause, f"choose {most} or less")


def check(world: World, *, learning: bool) -> None:
    """Raise ConfigError when a mission would send more than a message can hold."""
    for need in needs(world, learning=learning):
        if need.size > need.limit:
            more = f"{need.size:,} {need.unit}, and {need.message.__name__}.{need.field} takes {need.limit:,}"
            raise ConfigError(f"{need.cause} comes to {more}: {need.fix}")


def check_policy(size: int) -> None:
    """Raise PolicyError when a policy file of `size` bytes does not fit a message."""
    limit = int(fields.rules(m.Policy)["model"].high)
    if size > limit:
        raise PolicyError(f"it has {size:,} bytes, and a policy may have {limit:,}: train a smaller network")
