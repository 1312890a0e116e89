"""The table of topics: schema, and the process that writes them; see `docs/reference/log-format.md`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

from tmc.record.errors import RecordError

FORMAT = "2"
"""Version of the log format, in the metadata of each file: raised when settings, topics or fields are renamed."""
ACTIVE = ".active"
"""Appended to the name of a log while it is written."""
EVERY = "every"
"""The writer of a topic that every process logs."""


@dataclass(frozen=True)
class Channel:
    """One row. `<id>` in `topic` stands for the number of a UAV; `process` is the role of the writing process."""

    topic: str
    schema: str
    process: str
    about: str

    @cached_property
    def pattern(self) -> re.Pattern[str]:
        """A pattern that matches the topics of this row only."""
        return re.compile(re.escape(self.topic).replace("<id>", r"(0|[1-9][0-9]*)"))


CHANNELS: tuple[Channel, ...] = (
    Channel("/uav/<id>/record", "overfly.FlightRecord", "tmc", "each accepted flight record, once"),
    Channel(
        "/tmc/sync",
        "overfly.Sync",
        "tmc",
        "each answer to flight records: version of the map, and the UAVs that get it",
    ),
    Channel(
        "/tmc/episode", "overfly.Episode", "tmc", "begin of an episode, with the start cells; end, with its totals"
    ),
    Channel("/tmc/lost", "overfly.Lost", "tmc", "each UAV that is lost for the rest of the episode"),
    Channel("/tmc/state", "overfly.State", "tmc", "digests of the TMC's state at the end of an episode"),
    Channel("/tmc/events", "overfly.Events", "tmc", "scenario I: tick and cell of each event that appears"),
    Channel(
        "/tmc/metrics", "overfly.TeamMetrics", "tmc", "uncertainty of the true map, and mean reward per UAV, by tick"
    ),
    Channel("/tmc/last_visit", "foxglove.Grid", "tmc", "tick of the last visit of each cell, uint32"),
    Channel("/map/roads", "foxglove.GeoJSON", "tmc", "the road network, once"),
    Channel(
        "/learner/policy",
        "overfly.Policy",
        "tmc",
        "each accepted policy; the last one of a training with its ONNX model",
    ),
    Channel("/learner/metrics", "overfly.LearnerMetrics", "learner", "loss, Q values and updates per second, sampled"),
    Channel(
        "/uav/<id>/status", "overfly.UavStatus", "uav", "cell, steps per second and waiting time of the UAV, sampled"
    ),
    Channel(
        "/uav/<id>/observation_hash",
        "overfly.ObservationHashes",
        "uav",
        "in trials: a hash of each observation on which an action was chosen",
    ),
    Channel("/uav/<id>/fix", "foxglove.LocationFix", "uav", "position in degrees, sampled"),
    Channel("/log", "foxglove.Log", EVERY, "log lines of the process"),
)

REPLAY = "replay"
"""The writer of the topics of a replay file."""
REPLAY_CHANNELS: tuple[Channel, ...] = (
    Channel("/tmc/last_visit", "foxglove.Grid", REPLAY, "the true map: last_visit, uint32 ticks; uncertainty, float32"),
    Channel("/uav/<id>/belief", "foxglove.Grid", REPLAY, "the map that the UAV acts on, in the same fields"),
    Channel("/uav/<id>/pose", "foxglove.PoseInFrame", REPLAY, "position in the frame map, heading along the last move"),
    Channel("/uav/<id>/fix", "foxglove.LocationFix", REPLAY, "position in degrees, where the map has a place on earth"),
    Channel("/uav/<id>/tick", "overfly.UavTick", REPLAY, "cell, move, reward, and uncertainty of the UAV's own map"),
    Channel("/scene", "foxglove.SceneUpdate", REPLAY, "each UAV with its number and its trail of 20 cells"),
    Channel(
        "/tmc/tick",
        "overfly.TeamTick",
        REPLAY,
        "uncertainty of the true map and of the TMC's map; mean reward per UAV; blocked moves",
    ),
    Channel("/log", "foxglove.Log", REPLAY, "log lines on starts, blocked moves, and exchanges where T_u > 1"),
    Channel("/map/terrain", "foxglove.Grid", REPLAY, "once: terrain, uint8: 0 free, 1 road, 2 blocked"),
    Channel("/map/roads", "foxglove.GeoJSON", REPLAY, "once: the road network, where the map has streets"),
    Channel("/tf", "foxglove.FrameTransform", REPLAY, "once: from world to map"),
)
"""What `overfly log replay` writes: at every tick, unless the row says once."""


def uav_topic(uav: int, name: str) -> str:
    """Return the topic of one UAV, such as `/uav/3/record`."""
    return f"/uav/{uav}/{name}"


def role(process: str) -> str:
    """Return the role of a process: `uav` for `uav-003`."""
    return process.partition("-")[0]


def find(topic: str, process: str) -> Channel:
    """Return the row of a topic; RecordError when there is none, or when another process writes it."""
    for channel in CHANNELS:
        if channel.pattern.fullmatch(topic):
            if channel.process in (EVERY, role(process)):
                return channel
            raise RecordError(f"topic {topic} is written by {channel.process}, not by {process}: log it there")
    raise RecordError(f"there is no topic {topic}: add it to the table in tmc/record/channels.py, or correct its name")
