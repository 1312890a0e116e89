"""Rebuild the settings and the world of a run. The log's copy counts, even where the files were edited or removed."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from tmc.kernel import files
from tmc.kernel.config import Config, ConfigError, build, differences
from tmc.kernel.roadmap import DEFAULT_CELL_M, MAP_COPY, MapError, RoadMap, map_of_run, parse_raster
from tmc.kernel.world import World
from tmc.record.channels import FORMAT
from tmc.record.errors import RecordError
from tmc.record.mcap.strict import DamageError, contents
from tmc.record.reader import require_format
from tmc.record.run_folder import RunFolder

ATTACHED = frozenset(("config.json", "map.csv"))
"""The attachments at the start of the TMC's log."""
_NO_CONFIG = (ValueError, AttributeError, RecursionError)
"""Errors of text that is not a config: ConfigError is a ValueError, and so is broken JSON."""


@dataclass(frozen=True)
class Settings:
    """The settings of a run: the log's copy, or `config.json` where the log has none.

    `edited`: keys in which `config.json` differs. `notes`: what is wrong with `config.json`.
    """

    config: Config
    edited: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def world_of(folder: Path, tmc_log: Path) -> tuple[World, list[str]]:
    """Return the world, and notes on files that changed since the run; RecordError without a usable config."""
    attached = attachments(tmc_log)
    settings = _settings(folder, attached.get("config.json"))
    road_map, changed = _map(folder, settings.config, attached.get("map.csv"))
    try:
        return World(settings.config, road_map), [*settings.notes, *changed]
    except ConfigError as error:
        raise RecordError(f"the config of {folder} does not fit its map: {error}") from None


def settings_of(folder: Path, tmc_log: Path | None) -> Settings:
    """Return the settings of a run. `tmc_log` may be None. RecordError when neither log nor folder has them."""
    return _settings(folder, None if tmc_log is None else attachments(tmc_log).get("config.json"))


def attachments(tmc_log: Path) -> dict[str, str]:
    """Return {name: text} of the attachments at the start of the log; nothing behind them is read.

    Raises RecordError for a log of another format.
    """
    found: dict[str, str] = {}
    try:
        with tmc_log.open("rb") as file:
            for item in contents(file):
                require_format(tmc_log, item)
                name = getattr(item, "name", None)  # mcap's types are known to `record` only
                if name in ATTACHED:
                    found[name] = getattr(item, "data", b"").decode("utf-8", errors="replace")
                if found.keys() >= ATTACHED:
                    break
    except (OSError, DamageError):
        pass  # reported where the messages are read
    return found


def _settings(folder: Path, attached: str | None) -> Settings:
    """Return the settings, and how `config.json` differs from the log's copy of them."""
    path = RunFolder(folder).config
    logged = _parsed(attached)
    wrong = f"{folder} has no config.json"
    try:
        own = _build(files.read_text(path))
    except FileNotFoundError:
        own = None
    except (OSError, *_NO_CONFIG) as error:
        reason = getattr(error, "strerror", None) or error
        own, wrong = None, f"{path} is not the config of a run of log format {FORMAT} ({reason})"
    if logged is None:
        if own is None:
            raise RecordError(f"{wrong}, and its log holds none either: give the folder of a run")
        return Settings(own)
    if own is None:
        return Settings(
            logged, notes=(f"{path.name}: not a config; the log's settings are used",) if path.exists() else ()
        )
    edited = tuple(differences(own, logged))
    note = f"{path.name}: {', '.join(edited)} changed since the run; the log's settings are used"
    return Settings(logged, edited, (note,) if edited else ())


def _parsed(text: str | None) -> Config | None:
    """Return the log's copy of the settings; None where it has none that this version can read."""
    try:
        return None if text is None else _build(text)
    except _NO_CONFIG:
        return None


def _build(text: str) -> Config:
    return build(json.loads(text))


def _map(folder: Path, config: Config, csv: str | None) -> tuple[RoadMap, list[str]]:
    """Return the map of the run: the log's copy counts where the file is gone or was edited."""
    world = config.world
    try:
        road_map = map_of_run(folder, world.map, world.roads, world.obstacles)
    except MapError as error:
        if csv is None:
            raise RecordError(f"the run's map cannot be loaded, and its log has no copy: {error}") from None
        return map_of_csv(world.map, csv), [
            f"map {world.map}: its file is gone; the log's copy is used, with cells of {DEFAULT_CELL_M:g} m"
        ]
    if csv is None or road_map.csv() == csv:
        return road_map, []
    name = MAP_COPY if road_map.source and RunFolder(folder).map_copy.exists() else world.map
    return map_of_csv(world.map, csv, road_map.cell_m), [f"map {name}: changed since the run; the log's copy is used"]


def map_of_csv(name: str, csv: str, cell_m: float = DEFAULT_CELL_M) -> RoadMap:
    """Return the map in the log. It has no streets and uniform rates, since `RoadMap.csv` holds neither.

    RecordError when it is not intact.
    """
    try:
        return parse_raster(f"cell_m: {cell_m!r}\n{csv}", Path(name).stem, "the map in the log")
    except MapError as error:
        raise RecordError(f"the map in the log is not intact, so do not use this log: {error}") from None
