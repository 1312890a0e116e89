"""The TMC's journal: what the station wants recorded, written to its MCAP file and committed in groups.

What is committed survives what `journal.durability` says. Policy files would make the journal too large: those in use
lie beside it, in `policies/`, and the journal has their digests.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from google.protobuf.message import Message

from tmc.center.entries import JournalEntry
from tmc.center.roster import Outbox
from tmc.kernel.config import flat
from tmc.kernel.world import World
from tmc.record import builders
from tmc.record.channels import CHANNELS
from tmc.record.disk import write_atomically
from tmc.record.overfly_pb2 import TeamMetrics
from tmc.record.run_folder import RunFolder
from tmc.record.schemas import message_class
from tmc.record.writer import LogWriter

_SCHEMA = {c.topic: c.schema for c in CHANNELS}


class Journal:
    """Write the file `tmc.mcap` of a run: config and map as attachments, then one message per entry.

    `resume`: continue the journal that an earlier incarnation of the TMC left in the folder; `found` says whether it
    left one. `timer`: a monotonic clock (s).
    """

    def __init__(
        self,
        folder: Path,
        world: World,
        run: str,
        *,
        resume: bool = False,
        timer: Callable[[], float] = time.monotonic,
    ) -> None:
        self.world, self.folder = world, folder
        self._timer, self._started = timer, timer()
        self.found = resume and journal_in(folder) is not None
        self.writer = LogWriter(RunFolder(folder).journal, "tmc", world.config.journal, {"run": run}, resume=resume)
        self._policies: set[int] = set()
        self._stale = {*policies_in(folder)} if self.found else set[int]()
        self._since: float | None = None
        if not self.found:
            self._begin(world)
        else:  # the writer has synced what it took over
            self._append_ack()

    def _begin(self, world: World) -> None:
        config = json.dumps(flat(world.config), indent=1)
        self.writer.attach("config.json", "application/json", config.encode())
        self.writer.attach("map.csv", "text/csv", world.map.csv().encode())
        if world.map.streets:
            self.writer.write("/map/roads", builders.geojson(roads_geojson(world)))
        self.writer.flush()

    def take(self, outbox: Outbox) -> None:
        """Write the entries and notes of an outbox."""
        if outbox.entries and self._since is None:
            self._since = time.monotonic()
        for entry in outbox.entries:
            self.writer.write(entry.topic, self._message(entry), entry.sent or None)
        for level, text in outbox.notes:
            self.writer.log(level.lower(), text)

    @property
    def due(self) -> float | None:
        """Return the time until the next commit is due (s); None when everything is committed."""
        if self._since is None:
            return None
        return max(0.0, self._since + self.world.config.journal.commit_interval - time.monotonic())

    def commit(self) -> None:
        """Hand all entries over to the system, or to the disk, as `journal.durability` says."""
        self.writer.flush(fsync=self.world.config.journal.durability == "power")
        self._since = None
        self._append_ack()

    def _append_ack(self) -> None:
        """Log, in a trial with power cuts, how much of which file the disk has: the trial cuts the file there."""
        config = self.world.config
        if config.trial.ack_log and config.journal.durability == "power":
            path = RunFolder(self.folder).acks_of("tmc")
            path.parent.mkdir(exist_ok=True)
            now = self.writer.active.stat()
            with path.open("a", encoding="utf-8") as file:
                file.write(f"{now.st_ino} {now.st_size}\n")

    def keep_policies(self, held: Mapping[int, bytes]) -> None:
        """Make the folder `policies` hold these policies, and remove the others that it held."""
        for version in held.keys() - self._policies:
            path = policy_path(self.folder, version)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, held[version], sync=self.world.config.journal.durability == "power")
        for version in (self._policies | self._stale) - held.keys():
            policy_path(self.folder, version).unlink(missing_ok=True)
        self._policies, self._stale = set(held), set()

    def _message(self, entry: JournalEntry) -> Message:
        if "record" in entry.values:
            return builders.flight_record(entry.values["record"])
        if entry.topic == "/tmc/last_visit":
            grid, cell = self.world.grid, self.world.map.cell_m
            return builders.grid(entry.values["last_visit"], grid.rows, grid.cols, cell, time.time_ns())
        message = message_class(_SCHEMA[entry.topic])(**entry.values)
        if isinstance(message, TeamMetrics):
            message.elapsed = self._timer() - self._started
        return message


def journal_in(folder: Path) -> Path | None:
    """Return the journal in a run folder, finished or left behind; None if there is none, or it is empty."""
    return RunFolder(folder).existing_journal()


def policy_path(folder: Path, version: int) -> Path:
    """Return where the TMC keeps the policy with this version while a UAV may ask for it."""
    return RunFolder(folder).policy(version)


def policies_in(folder: Path) -> list[int]:
    """Return the versions of the policy files in a run folder."""
    return RunFolder(folder).policy_versions()


def roads_geojson(world: World) -> str:
    """Return the streets as a GeoJSON FeatureCollection, longitude first."""
    features = [
        {
            "type": "Feature",
            "properties": {"name": s.name, "class": s.road_class},
            "geometry": {"type": "LineString", "coordinates": [list(p) for p in s.lonlat]},
        }
        for s in world.map.streets
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})
