"""The world that a run flew in: from its config and, where the map's file has changed since, from the log."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tmc.kernel.config import Config, ConfigError, build
from tmc.kernel.grid import Grid
from tmc.kernel.roadmap import CELL_M, MapError, RoadMap, load_map
from tmc.kernel.world import World
from tmc.record.errors import RecordError
from tmc.record.frames import DamageError, contents

ATTACHED = frozenset(("config.json", "map.csv"))
"""What the TMC attaches at the start of its log."""
_NO_CONFIG = (ValueError, AttributeError)
"""What comes of text that is no config: ConfigError is a ValueError, and so is broken JSON."""


def world_of(folder: Path, tmc_log: Path) -> tuple[World, list[str]]:
    """The world, and a note where the map is no longer what was flown over; RecordError without a usable config."""
    attached = attachments(tmc_log)
    config, notes = _config(folder, attached.get("config.json"))
    road_map, changed = _map(config, attached.get("map.csv"))
    try:
        return World(config, road_map), notes + changed
    except ConfigError as error:
        raise RecordError(f"the config of {folder} does not fit its map: {error}") from None


def config_of(folder: Path, tmc_log: Path) -> Config:
    """The settings of a run: of its `config.json`, or of the log where that is gone or broken. RecordError."""
    return _config(folder, attachments(tmc_log).get("config.json"))[0]


def attachments(tmc_log: Path) -> dict[str, str]:
    """The text files at the start of the log; reads no further than them."""
    found: dict[str, str] = {}
    try:
        with tmc_log.open("rb") as file:
            for item in contents(file):
                name = getattr(item, "name", None)  # mcap's types are known to `record` only
                if name in ATTACHED:
                    found[name] = getattr(item, "data", b"").decode("utf-8", errors="replace")
                if found.keys() >= ATTACHED:
                    break
    except (OSError, DamageError):
        pass  # whoever reads the messages says so
    return found


def _config(folder: Path, attached: str | None) -> tuple[Config, list[str]]:
    """The config, and a note where the file of the folder is no config, so that the log's copy is used."""
    path = folder / "config.json"
    try:
        return _parsed(path.read_text("utf-8")), []
    except FileNotFoundError:
        wrong, notes = f"{folder} has no config.json", list[str]()
    except (OSError, *_NO_CONFIG) as error:
        wrong, notes = f"{path} is not the config of a run ({error})", [f"{path.name}: no config, the log's is used"]
    try:
        return _parsed(attached or ""), notes
    except _NO_CONFIG:
        raise RecordError(f"{wrong}, and its log holds none either: give the folder of a run") from None


def _parsed(text: str) -> Config:
    return build(json.loads(text))


def _map(config: Config, csv: str | None) -> tuple[RoadMap, list[str]]:
    """The map that was flown over: the log's copy wins over a file that is gone or was edited since."""
    world = config.world
    try:
        road_map = load_map(world.map, world.roads, world.obstacles)
    except MapError as error:
        if csv is None:
            raise RecordError(f"the run's map cannot be loaded, and its log has no copy: {error}") from None
        return map_of_csv(world.map, csv), [
            f"map {world.map}: its file is gone; the log's copy is used, with cells of {CELL_M:g} m"
        ]
    if csv is None or road_map.csv() == csv:
        return road_map, []
    return map_of_csv(world.map, csv, road_map.cell_m), [f"map {world.map}: changed since the run, the log's is used"]


def map_of_csv(name: str, csv: str, cell_m: float = CELL_M) -> RoadMap:
    """The inverse of `RoadMap.csv`, which holds neither streets nor rates other than uniform. RecordError."""
    try:
        codes = np.array([[int(c) for c in line.split(",")] for line in csv.split()])
        flat = codes.ravel()
        return RoadMap(Path(name).stem, Grid(*codes.shape), cell_m, flat == 1, flat == 2)
    except (ValueError, TypeError) as error:  # MapError is a ValueError
        raise RecordError(f"the map in the log is not sound, so do not use this log: {error}") from None
