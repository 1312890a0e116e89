"""Find who flies: a policy file, a run folder, or a planner."""

from __future__ import annotations

import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from actors.planners import PLANNERS, PREFIX
from tmc.analysis.run_config import settings_of
from tmc.kernel import files
from tmc.kernel.config import Config, ConfigError, flat
from tmc.kernel.files import plain
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.policy import PolicyCard, PolicyError
from tmc.kernel.roadmap import builtin_maps
from tmc.kernel.text import nearest, suggestion
from tmc.kernel.world import World
from tmc.record.run_folder import RunFolder
from tmc.wire import process
from tmc.wire.capacity import check_policy

KNOWN = tuple(PREFIX + name for name in PLANNERS)
"""The planners as a policy spec names them."""


@dataclass(frozen=True)
class PolicySpec:
    """A pilot by name, with the policy file's bytes unless it is a planner, and the settings that it brings along."""

    name: str
    policy: bytes | None
    values: dict[str, Any]


def resolve(name: str, say: Callable[[str], None] = process.tell) -> PolicySpec:
    """Find a policy or planner by name; `say` takes a sentence on each setting of a run folder that was edited since.

    Raises ConfigError with what may be written, or PolicyError if a file does not hold a policy.
    """
    if name.startswith(PREFIX):
        if name.removeprefix(PREFIX) not in PLANNERS:
            raise ConfigError(f"there is no planner '{plain(name, 60)}': {suggestion(name, KNOWN)}")
        return PolicySpec(name, None, {"team.controller": name})
    try:
        is_folder = stat.S_ISDIR(Path(name).stat().st_mode)
    except (OSError, ValueError):  # nothing of that name, or a name that nothing can have
        near = nearest(PREFIX + name, KNOWN) or nearest(name, KNOWN)
        fix = f"did you mean {near}?" if near else f"write one of these, or {', '.join(KNOWN)}"
        raise ConfigError(f"'{plain(name)}' is not a policy file, a run folder or a planner: {fix}") from None
    if is_folder:
        return _of_run(Path(name), say)
    return _of_file(name, Path(name), {})


def _of_run(folder: Path, say: Callable[[str], None]) -> PolicySpec:
    """The final policy of a run, in the mission that it was trained for."""
    journal, policy = RunFolder(folder).existing_journal(), RunFolder(folder).final_policy
    if journal is None and not RunFolder(folder).config.exists():
        raise ConfigError(f"{folder} is not a run folder: it has no config.json")
    settings = settings_of(folder, journal)
    for note in settings.notes:
        say(f"{folder}: {note}")
    values = dict(flat(settings.config)) | _map_of(folder, settings.config)
    if values["team.controller"] != "policy":
        return PolicySpec(str(folder), None, values)
    if not policy.exists():
        policy = RunFolder(folder).fixed_policy
    if not policy.exists():
        raise ConfigError(f"{folder} has no final policy: its training did not end")
    return _of_file(str(folder), policy, values)


def _map_of(folder: Path, config: Config) -> dict[str, Any]:
    """The map of a run that flew over a user's map: the copy in its folder, where there is one."""
    copy = RunFolder(folder).map_copy
    return {"world.map": str(copy)} if config.world.map not in builtin_maps() and copy.exists() else {}


def _of_file(name: str, path: Path, values: dict[str, Any]) -> PolicySpec:
    from actors.policy import read_card  # noqa: PLC0415  ONNX Runtime only where a policy flies

    try:
        check_policy(path.stat().st_size)
        model = files.read_bytes(path)
        card = read_card(model)
    except PolicyError as error:
        raise PolicyError(f"{plain(path)}: {error}") from None
    except OSError as error:
        fix = "give a policy file, a run folder or a planner"
        raise PolicyError(f"{plain(path)} cannot be read ({error.strerror}): {fix}") from None
    return PolicySpec(name, model, values | view_of(card) | {"team.controller": "policy"})


def view_of(card: PolicyCard) -> dict[str, Any]:
    """The settings that a policy needs to see what it was trained on."""
    return {
        "observation.view": card.view,
        "observation.radius": card.radius,
        "observation.near": card.near,
        "exploration.mask_blocked": card.mask_blocked,
    }


FIXED = {"exploration.start": 0.0, "exploration.end": 0.0}
"""A fixed policy flies as it is, without exploration."""
ONE_EPISODE: Mapping[str, Any] = {"training.episodes": 1, **FIXED}
"""What a mission of a fixed policy has in place of the defaults."""


def mission_values(spec: PolicySpec, *more: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the settings of a mission that a policy spec flies, without learning.

    First come those that the spec brings along, then one episode without exploration, then `more`, of which the later
    ones win. Only what flies is always the spec's.
    """
    merged = {**spec.values, **ONE_EPISODE}
    for values in more:
        merged |= values
    return merged | {"team.controller": spec.values["team.controller"]}


def require_policy(model: bytes, world: World, name: str) -> None:
    """Raise PolicyError, which names the policy, unless it can fly in this world, as far as can be seen before."""
    from actors.policy import PolicyController  # noqa: PLC0415  as above

    try:
        check_policy(len(model))
        PolicyController(model, world.config, ObservationBuilder(world))
    except PolicyError as error:
        raise PolicyError(f"{plain(name)}: {error}") from None


def is_planner(config: Config) -> bool:
    """True when a planner flies, and no policy."""
    return config.team.controller.startswith(PREFIX)
