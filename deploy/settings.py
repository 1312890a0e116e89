"""From presets and options to the one config. Presets are TOML files; options are short names for settings."""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Collection, Mapping
from importlib.resources import files
from typing import Any

from tmc.kernel.config import Config, ConfigError, build

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
        raise ConfigError(f"there is no preset '{name}': choose {', '.join(preset_names())}")
    table = tomllib.loads(files("deploy").joinpath("presets", f"{name}.toml").read_text("utf-8"))
    about, base = table.pop("about"), table.pop("base", None)
    values = read_preset(base)[0] if base else {}
    return values | _dotted(table), about


def _dotted(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in table.items():
        values |= _dotted(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return values


def add_options(parser: argparse.ArgumentParser, *, actors: bool = True, refused: Collection[str] = ()) -> None:
    """The options that missions share. `refused`: those that the command takes only to say what to write instead."""
    group = parser.add_argument_group("settings of the mission")
    for option, key, metavar in OPTIONS:
        if actors or option != "--actors":
            group.add_argument(option, metavar=metavar, help=argparse.SUPPRESS if option in refused else key)
    group.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="changes", help="any other setting"
    )


def chosen(args: argparse.Namespace) -> dict[str, str]:
    """The settings that the options name."""
    values = {}
    for option, key, _ in OPTIONS:
        value = getattr(args, option.removeprefix("--"), None)
        if value is not None:
            values[key] = value
    for change in args.changes:
        key, equals, value = change.partition("=")
        if not equals:
            raise ConfigError(f"--set {change} has no value: write --set {key}=VALUE")
        values[key.strip()] = value.strip()
    return values


def config_for(preset: str, values: Mapping[str, Any], base: Config | None = None) -> Config:
    """The config of a preset (on top of `base`, if given) with these settings changed."""
    return build(dict(read_preset(preset)[0]) | dict(values), base)
