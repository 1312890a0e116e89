"""The one configuration: its table, its defaults, what it converts, what it refuses, and the schedules it gives."""

from __future__ import annotations

import dataclasses
import json
import math
import tomllib
from typing import Any, Literal, get_args, get_origin

import pytest
from hypothesis import given
from hypothesis import settings as quick
from hypothesis import strategies as st

from tmc.kernel.config import SETTINGS, Config, ConfigError, build, check, flat, get

RANGES = [(s.key, s.low, s.high) for s in SETTINGS.values() if s.type in (int, float)]
QUICK = quick(max_examples=50, deadline=None)

NUMBERS = [s.key for s in SETTINGS.values() if s.type in (int, float)]
CHOICES = [s.key for s in SETTINGS.values() if get_origin(s.type) is Literal]
TABLE_I = {
    "dqn.learning_rate": 0.001,
    "replay.capacity": 100_000,
    "dqn.batch_size": 128,
    "dqn.target_episodes": 5,
    "dqn.gamma": 0.99,
    "network.kernel": 4,
    "network.dense": 64,
    "training.episodes": 500,
    "training.ticks": 1000,
    "exploration.start": 0.5,
    "exploration.end": 0.05,
}


def values_in_range(key: str) -> st.SearchStrategy[Any]:
    """Values that a setting may have, whatever the others are."""
    setting = SETTINGS[key]
    if setting.type is int:
        return st.integers(setting.low, setting.high)
    if setting.type is float:
        return st.floats(setting.low, setting.high)
    if setting.type is bool:
        return st.booleans()
    if get_origin(setting.type) is Literal:
        return st.sampled_from(get_args(setting.type))
    if get_origin(setting.type) is tuple:
        return st.lists(st.integers(1, 4096), min_size=1, max_size=4).map(tuple)
    return st.text(st.characters(codec="utf-8"), max_size=20)


# The table


@pytest.mark.parametrize("key", SETTINGS)
def test_every_setting_says_what_it_is(key: str) -> None:
    setting = SETTINGS[key]
    assert setting.about
    assert setting.about == setting.about.strip().rstrip(".")
    assert get(Config(), key) == setting.default
    assert key == key.lower()


@pytest.mark.parametrize("key", TABLE_I)
def test_every_default_of_table_i_names_it(key: str) -> None:
    assert SETTINGS[key].source == "Table I"
    assert SETTINGS[key].default == TABLE_I[key]


@pytest.mark.parametrize(
    "key", ["comms.period", "training.ticks", "world.alpha", "comms.silence_warning", "replay.capacity"]
)
def test_quantities_have_a_unit(key: str) -> None:
    assert SETTINGS[key].unit


@pytest.mark.parametrize("key", SETTINGS)
def test_numbers_and_lists_of_them_have_a_range_and_nothing_else(key: str) -> None:
    """The ends are of the setting's own type, so that what is printed of them can be typed."""
    setting = SETTINGS[key]
    kind = {int: int, float: float, tuple[int, ...]: int}.get(setting.type)
    assert [type(end) for end in (setting.low, setting.high)] == [kind or type(None)] * 2
    assert kind is None or setting.low < setting.high


def test_what_a_setting_may_be_is_said() -> None:
    assert SETTINGS["team.size"].allowed == "1 to 1,000"
    assert SETTINGS["dqn.learning_rate"].allowed == "1e-12 to 10"
    assert SETTINGS["training.seed"].allowed == "0 to 9,223,372,036,854,775,807"
    assert SETTINGS["dqn.loss"].allowed == "mse, huber"
    assert SETTINGS["dqn.double"].allowed == "true, false"
    assert SETTINGS["network.channels"].allowed == "1 to 4,096"
    assert SETTINGS["world.map"].allowed == ""


def test_the_settings_of_trials_are_known_as_such() -> None:
    assert {s.key.partition(".")[0] for s in SETTINGS.values() if s.trial} == {"trial"}


@pytest.mark.parametrize("key", CHOICES)
def test_defaults_are_among_their_choices(key: str) -> None:
    assert SETTINGS[key].default in get_args(SETTINGS[key].type)


def test_settings_come_in_order_and_once() -> None:
    keys = [setting.key for setting in SETTINGS.values()]
    assert keys[0] == "scenario"
    assert keys == list(SETTINGS)
    assert list(flat(Config())) == keys


def test_the_table_and_the_config_cannot_be_changed() -> None:
    with pytest.raises(TypeError):
        SETTINGS["dqn.gamma"] = None  # type: ignore[index]
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().dqn.gamma = 0.5  # type: ignore[misc]


def test_defaults_pass_their_own_check() -> None:
    check(Config())
    assert build({}) == Config()


# What build takes


@QUICK
@given(st.sets(st.sampled_from(list(SETTINGS)), max_size=8), st.data())
def test_flat_goes_through_json_and_back(keys: set[str], data: st.DataObject) -> None:
    values = {key: data.draw(values_in_range(key), label=key) for key in sorted(keys)}
    try:
        config = build(values)
    except ConfigError:
        return  # two settings that do not go together, see below
    assert {key: get(config, key) for key in values} == values
    assert build(json.loads(json.dumps(flat(config)))) == config
    assert build(flat(config), base=build({"scenario": 1})) == config, "flat names every setting"


def test_flat_holds_what_json_and_toml_hold() -> None:
    for key, value in flat(Config()).items():
        assert type(value) in (int, float, str, bool, list), key
    assert flat(Config())["network.channels"] == [16, 32]


def test_build_changes_only_what_is_named_and_not_its_base() -> None:
    base = build({"team.size": 5})
    config = build({"dqn.gamma": 0.9}, base)
    assert flat(config) == flat(base) | {"dqn.gamma": 0.9}
    assert base.dqn.gamma == 0.99


@pytest.mark.parametrize(
    ("key", "given_value", "value"),
    [
        ("team.size", "5", 5),
        ("team.size", 5.0, 5),
        ("training.seed", 2**63 - 1, 2**63 - 1),
        ("dqn.gamma", "0.95", 0.95),
        ("dqn.gamma", 1, 1.0),
        ("dqn.double", "true", True),
        ("dqn.double", "No", False),
        ("dqn.double", "1", True),
        ("network.channels", "8,16", (8, 16)),
        ("network.channels", " 8, 16 ", (8, 16)),
        ("network.channels", [8], (8,)),
        ("network.channels", (8, 16, 32), (8, 16, 32)),
        ("world.roads", "all", "all"),
        ("world.map", "plans/my town.txt", "plans/my town.txt"),
        ("scenario", "1", 1),
    ],
)
def test_values_of_the_command_line_json_and_toml_are_converted(key: str, given_value: Any, value: Any) -> None:
    got = get(build({key: given_value}), key)
    assert got == value
    assert type(got) is type(value)


def test_a_toml_document_builds() -> None:
    document = tomllib.loads("dqn.gamma = 1\nnetwork.channels = [4, 8]\ndqn.double = true\nscenario = 1\n")
    named = {f"{g}.{k}": v for g, group in document.items() if isinstance(group, dict) for k, v in group.items()}
    config = build({**named, "scenario": document["scenario"]})
    assert (config.dqn.gamma, config.network.channels, config.dqn.double, config.scenario) == (1.0, (4, 8), True, 1)


# What it refuses: one sentence that names the key


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("gamma", "did you mean dqn.gamma"),
        ("team.gamma", "did you mean dqn.gamma"),
        ("dqn", "dqn.learning_rate"),
        ("dqn.gama", "did you mean dqn.gamma?"),
        ("gama", "did you mean dqn.gamma?"),
        ("DQN.Gamma", "did you mean dqn.gamma?"),
        ("learning_rte", "did you mean dqn.learning_rate?"),
        ("training.publish_evry", "did you mean training.publish_every?"),
        ("stat", "did you mean world.start or exploration.start?"),
        ("dqn.gamma.x", "did you mean dqn.gamma?"),
        ("trial.stall_for", "overfly doctor --settings"),
        ("", "overfly doctor --settings"),
        ("zzz", "overfly doctor --settings"),
    ],
)
def test_unknown_keys_are_refused_with_a_hint(key: str, hint: str) -> None:
    with pytest.raises(ConfigError, match="there is no setting") as caught:
        build({key: 1})
    assert hint in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("team.size", True),
        ("team.size", 2.5),
        ("team.size", "2.5"),
        ("team.size", "three"),
        ("team.size", ""),
        ("team.size", None),
        ("team.size", [3]),
        ("team.size", math.nan),
        ("team.size", math.inf),
        pytest.param("team.size", "9" * 5000, id="team.size-of-5000-digits"),
        ("dqn.gamma", True),
        ("dqn.gamma", math.nan),
        ("dqn.gamma", "nan"),
        ("dqn.gamma", math.inf),
        ("dqn.gamma", "-inf"),
        ("dqn.gamma", None),
        ("dqn.gamma", "high"),
        ("dqn.gamma", [0.9]),
        pytest.param("dqn.gamma", 10**400, id="dqn.gamma-too-large-for-a-float"),
        ("dqn.double", 1),
        ("dqn.double", 0.0),
        ("dqn.double", "maybe"),
        ("dqn.double", None),
        ("world.roads", "side streets"),
        ("world.roads", ["main"]),
        ("world.roads", None),
        ("world.roads", True),
        ("network.channels", 16),
        ("network.channels", None),
        ("network.channels", "16;32"),
        ("network.channels", "16,,32"),
        ("network.channels", ["wide"]),
        ("network.channels", [16.5]),
        ("network.channels", [True]),
        ("network.channels", [math.inf]),
        ("network.channels", [math.nan]),
        ("world.map", None),
        ("world.map", ["downtown-toronto"]),
        ("team.controller", {"name": "policy"}),
        ("world.rates", False),
    ],
)
def test_values_of_another_type_are_refused(key: str, value: Any) -> None:
    with pytest.raises(ConfigError) as caught:
        build({key: value})
    assert str(caught.value).startswith(key)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("key", "low", "high"), RANGES)
def test_values_out_of_range_are_refused(key: str, low: float, high: float) -> None:
    whole = SETTINGS[key].type is int
    below = int(low) - 1 if whole else math.nextafter(low, -math.inf)
    above = int(high) + 1 if whole else math.nextafter(high, math.inf)
    for value in (below, above):
        with pytest.raises(ConfigError, match=rf"^{key} = .* is out of range"):
            build({key: value})


@pytest.mark.parametrize(("key", "low", "high"), RANGES)
def test_both_ends_of_a_range_are_taken(key: str, low: float, high: float) -> None:
    room = {"replay.capacity": 1_000_000_000, "replay.learn_start": 1, "dqn.target_updates": 1}
    room |= {"observation.view": "ego", "observation.radius": 100, "observation.near": 0}
    for value in (low, high):
        kind = SETTINGS[key].type
        assert get(build({**room, key: kind(value)}), key) == value


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"network.channels": []}, "network.channels"),
        ({"network.channels": [16, 0]}, "network.channels"),
        ({"network.channels": [5000]}, "network.channels"),
        ({"replay.capacity": 100}, "replay.learn_start is larger than replay.capacity"),
        ({"dqn.target_episodes": 0}, "the target would never follow"),
        ({"observation.near": 1}, "needs observation.view = ego"),
        (
            {"team.size": 300, "team.sensing_range": 100.0, "comms.period": 4000, "training.ticks": 4000},
            "a record could hold more than 1,000,000 sightings",
        ),
        (
            {"observation.view": "ego", "observation.radius": 2, "observation.near": 3},
            "observation.near is larger than observation.radius",
        ),
    ],
)
def test_settings_that_do_not_go_together_are_refused(values: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        build(values)


def test_check_sees_what_was_not_built() -> None:
    """A Config made by hand, with a NaN that every comparison lets pass."""
    config = Config()
    broken = dataclasses.replace(config, dqn=dataclasses.replace(config.dqn, gamma=math.nan))
    with pytest.raises(ConfigError, match=r"dqn\.gamma"):
        check(broken)


# The schedules


def test_epsilon_falls_linearly_over_the_first_part_of_the_episodes() -> None:
    config = build({"training.episodes": 101, "exploration.fraction": 0.8})
    assert config.epsilon(1) == 0.5
    assert config.epsilon(41) == pytest.approx(0.275)
    steps = [config.epsilon(e + 1) - config.epsilon(e) for e in range(1, 81)]
    assert steps == pytest.approx([-0.45 / 80] * 80)
    assert [config.epsilon(e) for e in range(81, 102)] == pytest.approx([0.05] * 21)


@QUICK
@given(st.integers(1, 600), st.floats(0, 1), st.floats(0, 1), st.floats(0, 1), st.integers(1, 600))
def test_epsilon_stays_between_its_ends(episodes: int, fraction: float, start: float, end: float, episode: int) -> None:
    config = build({
        "training.episodes": episodes, "exploration.fraction": fraction,
        "exploration.start": start, "exploration.end": end,
    })  # fmt: skip
    assert min(start, end) - 1e-12 <= config.epsilon(episode) <= max(start, end) + 1e-12


@pytest.mark.parametrize("values", [{"exploration.fraction": 0.0}, {"training.episodes": 1}])
def test_epsilon_without_room_to_fall_is_at_its_end(values: dict[str, Any]) -> None:
    assert build(values).epsilon(1) == pytest.approx(0.05)


def due_ticks(config: Config, uav: int) -> list[int]:
    return [t for t in range(config.training.ticks + 1) if config.due(uav, t)]


def test_together_all_exchange_at_t_mod_T_u_0() -> None:  # noqa: N802
    config = build({"comms.period": 10, "training.ticks": 35})
    assert all(due_ticks(config, i) == [0, 10, 20, 30, 35] for i in range(3))


def test_staggered_each_has_its_phase_and_the_end() -> None:
    config = build({"comms.period": 10, "comms.phase": "staggered", "training.ticks": 35, "team.size": 4})
    assert [config.phase(i) for i in range(4)] == [0, 2, 5, 7]
    assert due_ticks(config, 1) == [2, 12, 22, 32, 35]
    assert due_ticks(config, 3) == [7, 17, 27, 35]


@pytest.mark.parametrize("phase", ["together", "staggered"])
def test_scenario_i_exchanges_every_tick_whatever_the_period(phase: str) -> None:
    config = build({"scenario": 1, "comms.period": 10, "comms.phase": phase, "training.ticks": 5})
    assert config.T_u == 1
    assert all(due_ticks(config, i) == [0, 1, 2, 3, 4, 5] for i in range(3))


@pytest.mark.parametrize(("size", "period", "phase"), [(1, 1, "together"), (3, 10, "together"), (5, 7, "staggered")])
def test_the_next_record_is_due_at_the_first_tick_that_is(size: int, period: int, phase: str) -> None:
    values = {"team.size": size, "comms.period": period, "comms.phase": phase, "training.ticks": 25}
    config = build(values)
    for uav in range(size):
        for t in range(26):
            assert config.next_due(uav, t) == next(x for x in range(t, 26) if config.due(uav, x))


@QUICK
@given(st.integers(1, 80), st.integers(1, 60), st.integers(1, 30), st.sampled_from(["together", "staggered"]))
def test_everybody_ships_at_least_every_T_u_ticks_and_at_the_end(  # noqa: N802
    ticks: int, period: int, team: int, phase: str
) -> None:
    config = build({"training.ticks": ticks, "comms.period": period, "comms.phase": phase, "team.size": team})
    for uav in range(team):
        due = due_ticks(config, uav)
        assert due[-1] == ticks
        assert all(b - a <= period for a, b in zip([-1, *due], due, strict=False))
        assert 0 <= config.phase(uav) < period
