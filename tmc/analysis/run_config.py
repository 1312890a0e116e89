"""The world that a run flew in: the log's copy of settings and map is the truth, whatever became of the files."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from tmc.kernel import files
from tmc.kernel.config import Config, ConfigError, build, differences
from tmc.kernel.roadmap import COPY, USUAL_CELL_M, MapError, RoadMap, map_of_run, parse_raster
from tmc.kernel.world import World
from tmc.record.channels import FORMAT
from tmc.record.errors import RecordError
from tmc.record.mcap.parser import DamageError, contents
from tmc.record.reader import require_format

ATTACHED = frozenset(("config.json", "map.csv"))
"""What the TMC attaches at the start of its log."""
_NO_CONFIG = (ValueError, AttributeError, RecursionError)
"""What comes of text that is no config: ConfigError is a ValueError, and so is broken JSON."""


@dataclass(frozen=True)
class Settings:
    """The settings of a run. `edited`: keys in which `config.json` says something else; `notes`: what is wrong with it.

    The log's copy counts, and `config.json` where the log has none.
    """

    config: Config
    edited: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def world_of(folder: Path, tmc_log: Path) -> tuple[World, list[str]]:
    """The world, and notes where a file is no longer what was flown with; RecordError without a usable config."""
    attached = attachments(tmc_log)
    settings = _settings(folder, attached.get("config.json"))
    road_map, changed = _map(folder, settings.config, attached.get("map.csv"))
    try:
        return World(settings.config, road_map), [*settings.notes, *changed]
    except ConfigError as error:
        raise RecordError(f"the config of {folder} does not fit its map: {error}") from None


def settings_of(folder: Path, tmc_log: Path | None) -> Settings:
    """The settings of a run, whose log may not be there. RecordError where nothing has them."""
    return _settings(folder, None if tmc_log is None else attachments(tmc_log).get("config.json"))


def attachments(tmc_log: Path) -> dict[str, str]:
    """The text files at the start of the log; reads no further than them. RecordError for a log of another format."""
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
        pass  # whoever reads the messages says so
    return found


def _settings(folder: Path, attached: str | None) -> Settings:
    """The settings, and how `config.json` differs from the log's copy of them."""
    path = folder / "config.json"
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
        return Settings(logged, notes=(f"{path.name}: no config, the log's is used",) if path.exists() else ())
    edited = tuple(differences(own, logged))
    note = f"{path.name}: {', '.join(edited)} changed since the run, the log's settings are used"
    return Settings(logged, edited, (note,) if edited else ())


def _parsed(text: str | None) -> Config | None:
    """The log's copy of the settings; None where it has none that this Overfly knows."""
    try:
        return None if text is None else _build(text)
    except _NO_CONFIG:
        return None


def _build(text: str) -> Config:
    return build(json.loads(text))


def _map(folder: Path, config: Config, csv: str | None) -> tuple[RoadMap, list[str]]:
    """The map that was flown over: the log's copy wins over a file that is gone or was edited since."""
    world = config.world
    try:
        road_map = map_of_run(folder, world.map, world.roads, world.obstacles)
    except MapError as error:
        if csv is None:
            raise RecordError(f"the run's map cannot be loaded, and its log has no copy: {error}") from None
        return map_of_csv(world.map, csv), [
            f"map {world.map}: its file is gone; the log's copy is used, with cells of {USUAL_CELL_M:g} m"
        ]
    if csv is None or road_map.csv() == csv:
        return road_map, []
    name = COPY if road_map.source and (folder / COPY).exists() else world.map
    return map_of_csv(world.map, csv, road_map.cell_m), [f"map {name}: changed since the run, the log's is used"]


def map_of_csv(name: str, csv: str, cell_m: float = USUAL_CELL_M) -> RoadMap:
    """The map in the log: `RoadMap.csv` holds neither streets nor rates other than uniform. RecordError."""
    try:
        return parse_raster(f"cell_m: {cell_m!r}\n{csv}", Path(name).stem, "the map in the log")
    except MapError as error:
        raise RecordError(f"the map in the log is not intact, so do not use this log: {error}") from None
