"""Write the replay file of one episode for viewers: at every tick the maps, the UAVs and the metrics.

Its log time is the simulated clock, TICK_NS per tick, so an episode plays in minutes. The content follows from the
TMC's log alone. Overfly never reads a replay file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from tmc.analysis import palette
from tmc.analysis.run_data import UNKNOWN
from tmc.analysis.viewer import layout, messages
from tmc.analysis.viewer.beliefs import TMC, TRUE, UAV, Maps, maps
from tmc.analysis.viewer.timeline import Timeline, read_timeline
from tmc.kernel.grid import ACTIONS
from tmc.kernel.reward import Block
from tmc.kernel.world import World
from tmc.record import builders, overfly_pb2
from tmc.record.channels import FORMAT, uav_topic
from tmc.record.disk import write_atomically
from tmc.record.errors import RecordError
from tmc.record.mcap.export import Export
from tmc.record.run_folder import RunFolder

if TYPE_CHECKING:
    from foxglove_schemas_protobuf.Grid_pb2 import Grid
    from foxglove_schemas_protobuf.Log_pb2 import Log
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

TICK_NS = 100_000_000
"""Log time per tick, ns."""
TICK_S = 60
"""Simulated time per tick, s."""
TRAIL_TICKS = 20
"""Length of the trail behind a UAV."""
TERRAIN_Z_M = -1.0
"""Height of the terrain: below the maps, so that viewers draw them over it."""
BLOCKED_BY = {Block.GRID: "the edge of the grid", Block.OBSTACLE: "an obstacle", Block.UAV: "another UAV"}

Messages = Iterator[tuple[str, Message]]


@dataclass(frozen=True)
class Replayed:
    """What was written: the file, its layout beside it, and the episode in it."""

    path: Path
    layout: Path
    timeline: Timeline


def default_path(folder: Path, episode: int) -> Path:
    """Return the path of the replay file of an episode."""
    return RunFolder(folder).replay / f"episode-{episode:06d}.mcap"


def write(folder: Path, episode: int, out: Path, show: Callable[[str], None] = lambda _: None) -> Replayed:
    """Write the replay file of an episode of a run, and its layout as `<out's stem>.layout.json`.

    `show` gets the progress in words. RecordError when the log has nothing of the episode, or `out` cannot be written.
    """
    timeline = read_timeline(folder, episode, show)
    topics: set[str] = set()
    with Export(out) as export:
        facts = {"format": FORMAT, "process": "replay", "clock": "simulated", "tick_seconds": str(TICK_S)}
        export.add_metadata("overfly/replay", facts | {"episode": str(episode), "ticks": str(timeline.ticks)})
        for now in maps(timeline):
            for topic, message in tick_messages(timeline, now):
                export.write(topic, message, now.tick * TICK_NS)
                topics.add(topic)
            show(f"episode {episode}: tick {now.tick:,} of {timeline.ticks:,}")
        text = _layout(timeline, topics)
        export.attach(layout.FILE, "application/json", text.encode())
    beside = out.with_suffix(".layout.json")
    _write(beside, text)
    return Replayed(out, beside, timeline)


def tick_messages(timeline: Timeline, now: Maps) -> Messages:
    """Yield (topic, message) of one tick; at tick 0, first those that are written once."""
    if now.tick == 0:
        yield from _once(timeline)
    yield "/tmc/last_visit", _grid(timeline.world, now, TRUE)
    yield "/tmc/tick", _team_tick(timeline, now)
    present = np.flatnonzero(timeline.cells[now.tick] != UNKNOWN).tolist()
    for uav in present:
        yield from _uav(timeline, now, uav)
    yield "/scene", _scene(timeline, now.tick, present)
    yield from _log(timeline, now.tick, present)


def _once(timeline: Timeline) -> Messages:
    world = timeline.world
    yield "/tf", messages.world_to_map(0)
    terrain = np.where(world.map.blocked, 2, world.map.road).astype(np.uint8)
    message = builders.layers({"terrain": terrain}, world.grid.rows, world.grid.cols, world.map.cell_m, 0)
    message.pose.position.z = TERRAIN_Z_M
    yield "/map/terrain", message
    if timeline.roads:
        yield "/map/roads", builders.geojson(timeline.roads)


def _grid(world: World, now: Maps, row: int) -> Grid:
    """Return a row of the maps over all cells; cells that are not monitored are 0."""
    last_visit, uncertainty = np.zeros(world.grid.size, "<u4"), np.zeros(world.grid.size, "<f4")
    last_visit[world.law.cells], uncertainty[world.law.cells] = now.last_visit[row], now.uncertainty[row]
    fields: dict[str, NDArray[Any]] = {"last_visit": last_visit, "uncertainty": uncertainty}
    return builders.layers(fields, world.grid.rows, world.grid.cols, world.map.cell_m, now.tick * TICK_NS)


def _team_tick(timeline: Timeline, now: Maps) -> overfly_pb2.TeamTick:
    t, cells, sums = now.tick, timeline.world.law.cells.size, now.sums
    return overfly_pb2.TeamTick(
        episode=timeline.episode, tick=t, uncertainty=sums[TRUE], uncertainty_per_cell=sums[TRUE] / cells,
        believed=sums[TMC], believed_per_cell=sums[TMC] / cells, reward=timeline.reward[t],
        blocked=int((timeline.blocks[t] > 0).sum()), answered=len(timeline.answered.get(t, [])),
        uavs=int((timeline.cells[t] != UNKNOWN).sum()),
    )  # fmt: skip


def _uav(timeline: Timeline, now: Maps, uav: int) -> Messages:
    t, cell = now.tick, int(timeline.cells[now.tick, uav])
    yield uav_topic(uav, "belief"), _grid(timeline.world, now, UAV + uav)
    at = centre_of(timeline.world, cell)
    yield uav_topic(uav, "pose"), messages.pose_in_frame(at, _heading(timeline, t, uav), t * TICK_NS)
    lonlat = timeline.world.map.lonlat(cell)
    if lonlat is not None:
        yield uav_topic(uav, "fix"), builders.location_fix(*lonlat, t * TICK_NS)
    believed = float(now.sums[UAV + uav])
    yield uav_topic(uav, "tick"), overfly_pb2.UavTick(
        uav=uav, episode=timeline.episode, tick=t, cell=cell, action=int(timeline.actions[t, uav]),
        block=int(timeline.blocks[t, uav]), reward=float(timeline.rewards[t, uav]), believed=believed,
        believed_per_cell=believed / timeline.world.law.cells.size, exchanged=now.exchanged[uav],
        policy=int(timeline.policies[t, uav]),
    )  # fmt: skip


def centre_of(world: World, cell: int) -> messages.Point:
    """Return the centre of a cell, metres east and north of the south-west corner of the grid."""
    row, col = divmod(cell, world.grid.cols)
    return (col + 0.5) * world.map.cell_m, (world.grid.rows - row - 0.5) * world.map.cell_m


def _heading(timeline: Timeline, t: int, uav: int) -> float:
    """Return the direction of the last move that left a cell, radians from east to north; east before the first."""
    cells = timeline.cells[: t + 1, uav]
    moved = np.flatnonzero(np.diff(cells))
    if not moved.size:
        return 0.0
    _, d_row, d_col = ACTIONS[timeline.actions[moved[-1] + 1, uav]]
    return math.atan2(-d_row, d_col)


def _scene(timeline: Timeline, t: int, present: list[int]) -> SceneUpdate:
    world, first = timeline.world, max(0, t + 1 - TRAIL_TICKS)
    entities = []
    for uav in present:
        trail = [centre_of(world, cell) for cell in timeline.cells[first : t + 1, uav].tolist()]
        colour, shape = palette.colour_of(uav), palette.shape_of(uav)
        entities.append(messages.uav_entity(uav, trail, colour, shape, world.map.cell_m, t * TICK_NS))
    gone = (messages.entity_id(uav) for uav in range(timeline.cells.shape[1]) if uav not in present)
    return messages.scene(entities, gone, t * TICK_NS)


def _log(timeline: Timeline, t: int, present: list[int]) -> Messages:
    answered = timeline.answered.get(t)
    if answered and timeline.world.config.T_u > 1:  # at T_u = 1 it happens at every tick
        uavs = "all UAVs" if len(answered) == len(present) else f"UAV {', '.join(map(str, answered))}"
        yield "/log", _line("info", f"exchange with {uavs}", "tmc", t)
    for uav in present:
        if block := int(timeline.blocks[t, uav]):
            text = f"its move {ACTIONS[timeline.actions[t, uav]][0]} was blocked by {BLOCKED_BY[Block(block)]}"
            yield "/log", _line("warning", text, f"uav-{uav}", t)
        elif t == 0:
            yield "/log", _line("info", f"starts on cell {timeline.cells[0, uav]}", f"uav-{uav}", t)


def _line(level: str, text: str, name: str, t: int) -> Log:
    return builders.log_message(level, f"tick {t}: {text}", name, t * TICK_NS)


def _layout(timeline: Timeline, topics: set[str]) -> str:
    grid, team = timeline.world.grid, timeline.cells.shape[1]
    colours = [palette.colour_of(uav) for uav in range(team)]
    return json.dumps(layout.layout(topics, colours, grid.rows, grid.cols, timeline.world.map.cell_m), indent=1) + "\n"


def _write(path: Path, text: str) -> None:
    try:
        write_atomically(path, text.encode(), sync=False)
    except OSError as error:
        raise RecordError(f"{path} cannot be written ({error.strerror}): choose another place with --out") from None
