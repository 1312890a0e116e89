"""Makes the one config of presets and options. Presets are TOML files; options are short names for settings."""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Collection, Iterable, Mapping
from importlib.resources import files
from typing import Any

from tmc.kernel.config import SETTINGS, Config, ConfigError, Setting, build
from tmc.kernel.text import suggestion

# Option, setting, what argparse shows for its value. All else is --set key=value.
OPTIONS: tuple[tuple[str, str, str], ...] = (
    ("--actors", "team.size", "N"),
    ("--scenario", "scenario", "1|2"),
    ("--tu", "comms.period", "T"),
    ("--episodes", "training.episodes", "E"),
    ("--ticks", "training.ticks", "T"),
    ("--seed", "training.seed", "S"),
    ("--map", "world.map", "NAME"),
)


def preset_names() -> list[str]:
    """The presets that come with Overfly."""
    return sorted(p.name.removesuffix(".toml") for p in files("deploy").joinpath("presets").iterdir())


def read_preset(name: str) -> tuple[dict[str, Any], str]:
    """The settings of a preset as dotted keys, those of its base first, and its one-line description."""
    if name not in preset_names():
        raise ConfigError(f"there is no preset '{name}': {suggestion(name, preset_names())}")
    table = tomllib.loads(files("deploy").joinpath("presets", f"{name}.toml").read_text("utf-8"))
    about, base = table.pop("about"), table.pop("base", None)
    values = read_preset(base)[0] if base else {}
    own = _dotted(table)
    require_settable(own, f"the preset {name}")
    return values | own, about


def _dotted(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in table.items():
        values |= _dotted(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return values


def add_options(
    parser: argparse.ArgumentParser,
    *,
    actors: bool = True,
    refused: Collection[str] = (),
    defaults: Mapping[str, Any] | None = None,
) -> None:
    """Add the options that missions share.

    `refused`: options that the command takes only to say what to write instead; `defaults`: values that the command
    has in place of the settings' own.
    """
    group = parser.add_argument_group(
        "settings of the mission", "where a preset or a run folder has others, those hold"
    )
    for option, key, metavar in OPTIONS:
        if actors or option != "--actors":
            text = help_of(SETTINGS[key], (defaults or {}).get(key, SETTINGS[key].default))
            group.add_argument(option, metavar=metavar, help=argparse.SUPPRESS if option in refused else text)
    about = "any other setting; `overfly doctor --settings` lists all"
    group.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="changes", help=about)


def sentence(setting: Setting) -> str:
    """Return what a setting is and what it may be: "N, the number of UAVs (1 to 1,000 UAVs)"."""
    values = " ".join(filter(None, (setting.allowed, setting.unit)))
    return f"{setting.about} ({values})" if values else setting.about


def help_of(setting: Setting, default: Any) -> str:
    """Return the sentence of a setting with its default, for argparse."""
    text = sentence(setting).removesuffix(")")
    return f"{text}{'; ' if '(' in text else ' ('}default: {default})".replace("%", "%%")


def require_settable(keys: Iterable[str], where: str) -> None:
    """Raise ConfigError if one of the keys is a setting of trials, which stall UAVs or lose data by design."""
    for key in keys:
        if key in SETTINGS and SETTINGS[key].trial:
            raise ConfigError(f"{where} sets {key}, which only `overfly verify` may do: leave it out")


def chosen(args: argparse.Namespace) -> dict[str, Any]:
    """Return the settings that the options name, and those of a trial, if `deploy.cli.main` was given any."""
    values: dict[str, Any] = {}
    for option, key, _ in OPTIONS:
        value = getattr(args, option.removeprefix("--"), None)
        if value is not None:
            values[key] = value
    for change in args.changes:
        key, equals, value = change.partition("=")
        if not equals:
            raise ConfigError(f"--set {change} has no value: write --set {key}=VALUE")
        values[key.strip()] = value.strip()
    require_settable(values, "--set")
    return values | getattr(args, "trial", {})


def config_for(preset: str, values: Mapping[str, Any], base: Config | None = None) -> Config:
    """The config of a preset (on top of `base`, if given) with these settings changed."""
    return build(dict(read_preset(preset)[0]) | dict(values), base)
