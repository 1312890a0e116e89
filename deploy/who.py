"""WHO flies: a policy file, a run folder, or a planner."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from actors.planners import PLANNERS, PREFIX
from tmc.kernel.config import Config, ConfigError, build, flat
from tmc.kernel.policy import PolicyCard, PolicyError, require
from tmc.kernel.world import World


@dataclass(frozen=True)
class Who:
    """A pilot by name, with the policy file's bytes unless it is a planner, and the settings that it brings along."""

    name: str
    policy: bytes | None
    values: dict[str, Any]


def resolve(name: str) -> Who:
    """Find WHO; raises ConfigError with what may be written, or PolicyError for a file that is no policy."""
    if name.startswith(PREFIX):
        if name.removeprefix(PREFIX) not in PLANNERS:
            raise ConfigError(f"there is no planner '{name}': choose {', '.join(PREFIX + p for p in PLANNERS)}")
        return Who(name, None, {"team.pilot": name})
    path = Path(name)
    if path.is_dir():
        return _of_run(path)
    if not path.is_file():
        known = ", ".join(PREFIX + p for p in PLANNERS)
        raise ConfigError(f"'{name}' is no policy file and no run folder: write one of these, or {known}")
    return _of_file(name, path, {})


def _of_run(folder: Path) -> Who:
    """The final policy of a run, in the mission that it was trained for."""
    config, policy = folder / "config.json", folder / "policies" / "final.onnx"
    if not config.is_file():
        raise ConfigError(f"{folder} is no run folder: it has no config.json")
    try:
        values = dict(flat(build(json.loads(config.read_text("utf-8")))))
    except (AttributeError, TypeError, ValueError) as error:
        raise ConfigError(f"{config} cannot be read: {error}") from None
    if values.get("team.pilot", "policy") != "policy":
        return Who(str(folder), None, values)
    if not policy.is_file():
        policy = folder / "policies" / "flown.onnx"
    if not policy.is_file():
        raise ConfigError(f"{folder} has no final policy: its training did not end")
    return _of_file(str(folder), policy, values)


def _of_file(name: str, path: Path, values: dict[str, Any]) -> Who:
    from actors.policy import read_card  # noqa: PLC0415  ONNX Runtime only where a policy flies

    model = path.read_bytes()
    try:
        card = read_card(model)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None
    return Who(name, model, values | view_of(card) | {"team.pilot": "policy"})


def view_of(card: PolicyCard) -> dict[str, Any]:
    """The settings that a policy needs to see what it was trained on."""
    return {
        "observation.view": card.view,
        "observation.radius": card.radius,
        "observation.near": card.near,
        "exploration.mask_blocked": card.mask_blocked,
    }


def pilot_of(who: Who) -> dict[str, Any]:
    """The one setting that WHO decides, whatever else is set."""
    return {"team.pilot": who.values["team.pilot"]}


FIXED = {"exploration.start": 0.0, "exploration.end": 0.0}
"""A fixed policy flies as it is, without exploration."""


def require_policy(model: bytes, world: World) -> None:
    """Raise PolicyError unless this policy can fly in this world."""
    from actors.policy import read_card  # noqa: PLC0415  as above

    require(read_card(model), world.config, world.grid)


def is_planner(config: Config) -> bool:
    """True when a planner flies, and no policy."""
    return config.team.pilot.startswith(PREFIX)
