"""Writes what the station wants journalled into the TMC's MCAP file."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from tmc.entries import Entry
from tmc.kernel.config import flat
from tmc.kernel.world import World
from tmc.record import builders
from tmc.record.channels import CHANNELS
from tmc.record.schemas import message_class
from tmc.record.writer import LogWriter
from tmc.roster import Outbox

_SCHEMA = {c.topic: c.schema for c in CHANNELS}


class Journal:
    """The file `tmc.mcap` of a run: config and map as attachments, then one message an entry."""

    def __init__(self, folder: Path, world: World, run: str) -> None:
        self.world = world
        self.writer = LogWriter(folder / "tmc.mcap", "tmc", world.config.journal, {"run": run})
        config = json.dumps(flat(world.config), indent=1)
        self.writer.attach("config.json", "application/json", config.encode())
        self.writer.attach("map.csv", "text/csv", world.map.csv().encode())
        if world.map.streets:
            self.writer.write("/map/roads", builders.geojson(roads_geojson(world)))
        self.writer.flush()

    def take(self, outbox: Outbox) -> None:
        """Write the entries and notes of an outbox."""
        for entry in outbox.entries:
            self.writer.write(entry.topic, self._message(entry))
        for level, text in outbox.notes:
            self.writer.log(level.lower(), text)

    def _message(self, entry: Entry) -> Any:
        if "record" in entry.values:
            return builders.flight_record(entry.values["record"])
        if entry.topic == "/tmc/last_visit":
            grid, cell = self.world.grid, self.world.map.cell_m
            return builders.grid(entry.values["last_visit"], grid.rows, grid.cols, cell, time.time_ns())
        return message_class(_SCHEMA[entry.topic])(**entry.values)


def roads_geojson(world: World) -> str:
    """The streets as a GeoJSON FeatureCollection, longitude first."""
    features = [
        {
            "type": "Feature",
            "properties": {"name": s.name, "class": s.road_class},
            "geometry": {"type": "LineString", "coordinates": [list(p) for p in s.lonlat]},
        }
        for s in world.map.streets
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})
