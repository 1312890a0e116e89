"""The one configuration: each setting with default, range, unit and source. Files, options and log metadata follow.

The defaults are the paper's (Table I and Sec. IV), so the preset `paper` changes nothing. A setting is named by its
dotted key, such as `dqn.gamma`; `overfly run --set dqn.gamma=0.95` and the TOML presets use these same keys.
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Literal, get_args, get_origin, get_type_hints

from tmc.kernel.errors import OverflyError
from tmc.kernel.files import plain
from tmc.kernel.text import nearest

MAX_SIGHTINGS = 1_000_000
"""Most sightings of a flight record; the rule of `tmc.wire.messages.Record` is made of it."""
TRIAL = "trial."
"""Prefix of the settings that only `overfly verify` changes: they stall UAVs, or lose data by design."""


class ConfigError(OverflyError, ValueError):
    """A setting that cannot be: one sentence with the key and the fix."""


def _s(
    default: Any, about: str, unit: str = "", source: str = "", *, low: float | None = None, high: float | None = None
) -> Any:
    """Make the field of a setting.

    `about`: what it is, in one sentence; `source`: where in the paper, or in our decisions, the default comes from;
    `low` and `high`: the range of a number, or of each number of a list, both ends included.
    """
    return field(default=default, metadata={"about": about, "unit": unit, "source": source, "low": low, "high": high})


@dataclass(frozen=True)
class WorldConfig:
    map: str = _s("downtown-toronto", "built-in map, or a text raster file", source="Sec. IV-A, Fig. 2(a)")
    roads: Literal["major", "main", "arterial", "all"] = _s(
        "main", "which classes of street are monitored", source="Sec. IV-A"
    )
    obstacles: Literal["none", "static", "event-day"] = _s(
        "static", "static obstacles and no-fly cells", source="Sec. II-A"
    )
    alpha: float = _s(0.01, "rate of event arrival in a road cell", "events/tick", "Sec. IV-A", low=1e-9, high=10.0)
    rates: str = _s("uniform", "relative rates per road cell: uniform, volume or blend", source="Sec. IV-A: uniform")
    alpha_offroad: float = _s(
        0.0, "rate in cells that are not road", "events/tick", "Sec. II: the roads are what is monitored",
        low=0.0, high=10.0,
    )  # fmt: skip
    start: Literal["free", "road"] = _s(
        "free", "cells that UAVs start on, distinct and at random", source="Algorithm 1: random positions"
    )
    initial_map: Literal["visited", "random"] = _s(
        "visited", "uncertainty at t = 0: zero, or uniform in (0, 1)", source="Fig. 4(b): random"
    )


@dataclass(frozen=True)
class TeamConfig:
    size: int = _s(3, "N, the number of UAVs", "UAVs", "Sec. IV-C", low=1, high=1000)
    controller: str = _s("policy", "what flies the UAVs: policy, planner:random, planner:random-road or planner:greedy")
    sensing_range: float = _s(1.5, "r_s in scenario II", "cell widths d", "Sec. IV-B", low=0.0, high=1000.0)


@dataclass(frozen=True)
class CommsConfig:
    period: int = _s(
        10, "T_u between two exchanges with the TMC; scenario I always has 1", "ticks", "Sec. II-C", low=1, high=60_000
    )
    phase: Literal["together", "staggered"] = _s(
        "together", "all UAVs exchange at t mod T_u = 0, or UAV i at floor(i T_u / N)", source="Algorithm 1; Sec. II-C"
    )
    silence_warning: float = _s(
        30.0, "silence after which the TMC names a UAV that others wait for", "s", low=0.1, high=1e6
    )
    lost_after: float = _s(
        60.0, "silence after which the TMC declares a UAV lost; the others continue without it", "s", low=1.0, high=1e6
    )


@dataclass(frozen=True)
class RewardConfig:
    collision: float = _s(
        -20.0, "r^c of a blocked move, instead of any other reward", source="Sec. IV-B", low=-1e6, high=1e6
    )
    new_cell: float = _s(1.0, "r^n of a cell not visited so far in the episode", source="Sec. IV-B", low=-1e6, high=1e6)
    weight: float = _s(5.0, "lambda, the weight of r^u in eq. (13)", source="Sec. IV-B", low=-1e6, high=1e6)
    uncertainty: Literal["true", "own"] = _s(
        "true", "r^u of the true map, written by the TMC, or of the UAV's own", source="Sec. III-B: r^u = u_k(t)"
    )
    novelty: Literal["own", "team"] = _s(
        "own", "r^n counts the UAV's own visits, or the team's", source="Sec. III-B, left open"
    )
    aligned: bool = _s(
        False, "r^u = u_k / (1 - gamma q_k), the team's objective for uneven rates", source="docs/adr/0006"
    )


@dataclass(frozen=True)
class ExplorationConfig:
    start: float = _s(0.5, "epsilon in the first episode", source="Table I", low=0.0, high=1.0)
    end: float = _s(0.05, "epsilon in the last episodes", source="Table I", low=0.0, high=1.0)
    fraction: float = _s(
        0.8, "share of the episodes over which epsilon falls linearly", source="left open", low=0.0, high=1.0
    )
    mask_blocked: bool = _s(
        False, "never choose a move that is known to be blocked (grid, obstacles, sensed UAVs)", source="ours"
    )


@dataclass(frozen=True)
class ObservationConfig:
    view: Literal["whole", "ego"] = _s("whole", "the whole grid, or a square around the UAV", source="eq. (12): whole")
    radius: int = _s(8, "half width of the egocentric view: 2 radius + 1 cells", "cells", low=1, high=100)
    near: int = _s(
        0, "also feed the (2 near + 1)^2 cells around the UAV to the dense layer; 0: off", "cells", low=0, high=100
    )


@dataclass(frozen=True)
class NetworkConfig:
    channels: tuple[int, ...] = _s(
        (16, 32), "filters of each convolution", source="Fig. 2(b), not available", low=1, high=4096
    )
    kernel: int = _s(4, "width of the filters", "cells", "Table I", low=1, high=64)
    stride: int = _s(2, "stride of the convolutions", "cells", "left open", low=1, high=64)
    dense: int = _s(64, "units of the fully connected layer", source="Table I", low=1, high=65_536)


@dataclass(frozen=True)
class DqnConfig:
    learning_rate: float = _s(1e-3, "Adam's step size", source="Table I", low=1e-12, high=10.0)
    batch_size: int = _s(128, "b, transitions in a minibatch", "transitions", "Table I", low=1, high=65_536)
    gamma: float = _s(0.99, "discount factor", "1/tick", "Table I", low=0.0, high=1.0)
    n_step: int = _s(1, "rewards summed before the bootstrap", "ticks", "eq. (8): 1", low=1, high=1000)
    double: bool = _s(False, "choose a' by the online network (double Q-learning)", source="eq. (8): no")
    loss: Literal["mse", "huber"] = _s("mse", "loss of Q against its target", source="eq. (9)")
    reward_scale: float = _s(1.0, "factor on rewards as the learner sees them", source="eq. (9): 1", low=1e-9, high=1e9)
    target_episodes: int = _s(
        5, "f: copy theta to theta- every f episodes; 0: off", "episodes", "Table I", low=0, high=1_000_000
    )
    target_updates: int = _s(
        0, "copy theta to theta- every so many updates; 0: off", "updates", low=0, high=1_000_000_000
    )


@dataclass(frozen=True)
class ReplayConfig:
    capacity: int = _s(
        100_000, "transitions that the replay memory holds", "transitions", "Table I", low=1, high=1_000_000_000
    )
    learn_start: int = _s(
        128, "transitions before the first minibatch", "transitions", "left open: b", low=1, high=1_000_000_000
    )
    updates_per_tick: float = _s(
        1.0, "minibatches per tick of the team", "updates/tick", "Algorithm 1: one", low=0.0, high=1000.0
    )
    priority_exponent: float = _s(
        0.0, "alpha: a transition is drawn in proportion to |TD error|^alpha; 0: uniformly",
        source="eq. (8): uniform", low=0.0, high=1.0,
    )  # fmt: skip
    importance_exponent: float = _s(
        0.4, "beta: weights in the loss that make up for it, in full at 1", source="Schaul et al. 2016, Sec. 3.4",
        low=0.0, high=1.0,
    )  # fmt: skip
    error_buffer: int = _s(
        200, "how far ticks and updates may drift apart before the limiter holds one back", "ticks",
        low=1, high=1_000_000,
    )  # fmt: skip


@dataclass(frozen=True)
class TrainingConfig:
    episodes: int = _s(500, "E, the number of episodes", "episodes", "Table I", low=1, high=10_000_000)
    ticks: int = _s(1000, "T_ep, the length of an episode", "ticks of 60 s", "Table I", low=1, high=60_000)
    seed: int = _s(1, "key of every random draw", low=0, high=2**63 - 1)
    publish_every: int = _s(
        100, "updates between two policies pushed to the TMC", "updates", "left open", low=1, high=1_000_000_000
    )
    checkpoint_every: int = _s(5000, "updates between two checkpoints", "updates", low=1, high=1_000_000_000)
    threads: int = _s(1, "threads of the learner's arithmetic", "threads", low=1, high=1024)


@dataclass(frozen=True)
class JournalConfig:
    flush_interval: float = _s(0.5, "longest time that a logged message stays in the process", "s", low=0.01, high=60.0)
    commit_interval: float = _s(
        0.05, "longest time that an accepted flight record waits for the TMC's group commit", "s", low=0.0, high=60.0
    )
    durability: Literal["process", "power"] = _s(
        "process", "what a committed record survives: kill -9 of the TMC, or a power cut as well (fsync)"
    )
    chunk: int = _s(262_144, "size of an MCAP chunk before compression", "bytes", low=1024, high=64 * 1024 * 1024)


@dataclass(frozen=True)
class TrialConfig:
    """What `overfly verify` does to a mission in order to test it. An ordinary mission has none of it."""

    stall: float = _s(
        0.0, "how long a UAV's process stalls before it beacons its cell; 0: never", "s", low=0.0, high=60.0
    )
    stall_share: float = _s(1.0, "probability that it stalls at a tick", "1/tick", low=0.0, high=1.0)
    stall_spread: float = _s(
        0.0, "stalls last from (1 - spread) to (1 + spread) times as long, at random", low=0.0, high=1.0
    )
    stall_uav: int = _s(-1, "the one UAV that stalls; -1: all of them", low=-1, high=65_535)
    observation_hash: bool = _s(False, "UAVs log a hash of each observation that they decide on")
    ack_log: bool = _s(False, "each UAV keeps a file of which of its records were acknowledged")
    ack_early: bool = _s(False, "the TMC acknowledges records before it has committed them, so some get lost")


@dataclass(frozen=True)
class Config:
    """All settings of a mission. Immutable; `check` has been passed by every instance that `build` returns."""

    scenario: int = _s(2, "1: continuous communication, 2: limited communication", source="Sec. II-B", low=1, high=2)
    world: WorldConfig = field(default_factory=WorldConfig)
    team: TeamConfig = field(default_factory=TeamConfig)
    comms: CommsConfig = field(default_factory=CommsConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    dqn: DqnConfig = field(default_factory=DqnConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    journal: JournalConfig = field(default_factory=JournalConfig)
    trial: TrialConfig = field(default_factory=TrialConfig)

    @property
    def T_u(self) -> int:
        """Ticks between two exchanges; scenario I is continuous communication, so 1 (Sec. II-C)."""
        return 1 if self.scenario == 1 else self.comms.period

    def phase(self, uav: int) -> int:
        """UAV `uav` exchanges with the TMC at t mod T_u = phase."""
        return uav * self.T_u // self.team.size if self.comms.phase == "staggered" else 0

    def due(self, uav: int, t: int) -> bool:
        """True when UAV `uav` ships its record at tick t: at its phase, and at the episode's end."""
        return t % self.T_u == self.phase(uav) or t == self.training.ticks

    def next_due(self, uav: int, t: int) -> int:
        """The first tick from `t` on at which UAV `uav` ships its record."""
        return min(t + (self.phase(uav) - t) % self.T_u, self.training.ticks)

    def epsilon(self, episode: int) -> float:
        """Exploration rate of an episode (counted from 1): linear over the first `fraction` of all episodes.

        It is `end` from episode 1 + fraction * (E - 1) on, so in all of them where there is no room to fall.
        """
        e, span = self.exploration, self.exploration.fraction * (self.training.episodes - 1)
        return e.end if episode - 1 >= span else e.start + (e.end - e.start) * (episode - 1) / span


@dataclass(frozen=True)
class Setting:
    """One row of the table of settings; `low` and `high` are None for what is not a number."""

    key: str
    type: Any
    default: Any
    about: str
    unit: str
    source: str
    low: float | None
    high: float | None

    @property
    def trial(self) -> bool:
        """True for a setting that only `overfly verify` changes."""
        return self.key.startswith(TRIAL)

    @property
    def allowed(self) -> str:
        """The values that it may have, as text: a range, or choices; empty for names and paths."""
        if self.low is not None and self.high is not None:
            return " to ".join(f"{end:,}" if isinstance(end, int) else f"{end:,.10g}" for end in (self.low, self.high))
        choices = ("true", "false") if self.type is bool else get_args(self.type)
        return ", ".join(map(str, choices))


def _settings(cls: type, prefix: str) -> Iterator[Setting]:
    """Every setting, in the order of the classes above."""
    hints = get_type_hints(cls)
    for f in dataclasses.fields(cls):
        kind = hints[f.name]
        if dataclasses.is_dataclass(kind):
            yield from _settings(kind, f"{f.name}.")  # type: ignore[arg-type]  # a class, not an instance
        else:
            yield Setting(prefix + f.name, kind, f.default, **f.metadata)


SETTINGS: Mapping[str, Setting] = types.MappingProxyType({s.key: s for s in _settings(Config, "")})


def get(config: Config, key: str) -> Any:
    """The value of a dotted key."""
    return attrgetter(key)(config)


def flat(config: Config) -> dict[str, Any]:
    """All settings as {dotted key: value}; tuples become lists, so that it goes through JSON and TOML unchanged."""
    values = {key: get(config, key) for key in SETTINGS}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}


def differences(config: Config, other: Config) -> list[str]:
    """The keys of the settings in which two configs differ, in order."""
    return [key for key in SETTINGS if get(config, key) != get(other, key)]


def build(values: Mapping[str, Any], base: Config | None = None) -> Config:
    """`base` (the paper's config by default) with dotted keys replaced, each converted to its type, all checked."""
    config = base or Config()
    for key, value in values.items():
        config = _replace(config, key, _convert(_setting(key), value))
    check(config)
    return config


def _setting(key: str) -> Setting:
    if key in SETTINGS:
        return SETTINGS[key]
    hint = f"did you mean {' or '.join(near)}?" if (near := _near(key)) else "`overfly doctor --settings` lists them"
    raise ConfigError(f"there is no setting '{plain(key, 60)}': {hint}")


def _near(key: str) -> list[str]:
    """The settings that may have been meant: of that last word, of that group, or else of a similar name."""
    known = {k: k.rpartition(".")[2] for k in SETTINGS if not k.startswith(TRIAL)}
    last = key.rpartition(".")[2]
    if near := [k for k, name in known.items() if name == last or k.startswith(f"{key}.")]:
        return near
    if similar := nearest(key, known):
        return [similar]
    name = "" if key.startswith(TRIAL) else nearest(last, known.values())
    return [k for k in known if name and known[k] == name]


def _replace(config: Config, key: str, value: Any) -> Config:
    group, _, name = key.rpartition(".")
    if not group:
        return dataclasses.replace(config, **{name: value})
    return dataclasses.replace(config, **{group: dataclasses.replace(getattr(config, group), **{name: value})})


def _convert(setting: Setting, value: Any) -> Any:
    """A value from TOML, JSON or the command line (a string) in the setting's own type."""
    kind, key = setting.type, setting.key
    try:
        if get_origin(kind) is Literal:
            if value not in get_args(kind):
                raise ConfigError(f"{key} = {plain(repr(value), 60)} is none of {', '.join(map(str, get_args(kind)))}")
            return value
        if get_origin(kind) is tuple:
            items = value.split(",") if isinstance(value, str) else value
            return tuple(_as_int(v) for v in items)
        if kind is bool:
            return _as_bool(value)
        if kind is int:
            return _as_int(value)
        if kind is float:
            number = float(value)
            if isinstance(value, bool) or not math.isfinite(number):
                raise ValueError
            return number
        if not isinstance(value, str):
            raise ValueError
        return value
    except ConfigError:
        raise
    except (TypeError, ValueError, OverflowError):
        name = getattr(kind, "__name__", str(kind))
        raise ConfigError(
            f"{key} = {plain(repr(value), 60)} is not {'a list of int' if name == 'tuple' else f'of type {name}'}"
        ) from None


def _as_bool(value: Any) -> bool:
    names = {"true": True, "false": False, "1": True, "0": False, "yes": True, "no": False}
    if isinstance(value, bool):
        return value
    if isinstance(value, str) and value.lower() in names:
        return names[value.lower()]
    raise ValueError


def _as_int(value: Any) -> int:
    if isinstance(value, bool) or (isinstance(value, float) and not value.is_integer()):
        raise ValueError
    return int(value)


def check(config: Config) -> None:
    """Refuse impossible settings; raises ConfigError with the reason and the fix."""
    for reason in _out_of_range(config):
        raise ConfigError(reason)
    for reason in _contradictions(config):
        raise ConfigError(reason)


def _out_of_range(config: Config) -> Iterator[str]:
    for key, setting in SETTINGS.items():
        if setting.low is None or setting.high is None:
            continue
        value = get(config, key)
        items = value if isinstance(value, tuple) else (value,)
        if any(not setting.low <= item <= setting.high for item in items):  # a NaN is in no range
            yield f"{key} = {plain(value, 60)} is out of range: choose {setting.allowed}"


def _contradictions(config: Config) -> Iterator[str]:
    """What does not go together, though each value is in its range."""
    near = min(config.team.size, int(2 * config.team.sensing_range + 1) ** 2) - 1
    if near * (min(config.T_u, config.training.ticks) + 1) > MAX_SIGHTINGS:
        yield f"a record could hold more than {MAX_SIGHTINGS:,} sightings: lower team.sensing_range, or comms.period"
    if not config.network.channels:
        yield "network.channels is empty: list the filters of at least one convolution"
    if config.replay.learn_start > config.replay.capacity:
        yield "replay.learn_start is larger than replay.capacity, so learning would never start: lower it"
    if config.dqn.target_episodes == 0 and config.dqn.target_updates == 0:
        yield "dqn.target_episodes and dqn.target_updates are both 0, so the target would never follow: raise one"
    if config.observation.view == "ego" and config.observation.near > config.observation.radius:
        yield "observation.near is larger than observation.radius: lower it"
    if config.observation.view == "whole" and config.observation.near:
        yield "observation.near needs observation.view = ego"
