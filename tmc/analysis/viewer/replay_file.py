"""The viewer's file of one episode: every tick the true map, each UAV's own, where everybody is, and the metrics.

Its log time is the simulated clock, TICK_NS a tick, so that an episode plays in minutes and 500 of them would still
fit what viewers can preload. Everything in it follows from the TMC's log; nothing is read back from it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmc.analysis import palette
from tmc.analysis.run_data import UNKNOWN
from tmc.analysis.viewer import layout, messages, timeline
from tmc.analysis.viewer.beliefs import TMC, TRUE, UAV, Maps, maps
from tmc.analysis.viewer.timeline import Timeline
from tmc.kernel.grid import ACTIONS
from tmc.kernel.reward import Block
from tmc.kernel.world import World
from tmc.record import builders, schemas
from tmc.record.channels import FORMAT, uav_topic
from tmc.record.errors import RecordError
from tmc.record.mcap.export import Export

TICK_NS = 100_000_000
"""Log time of a tick."""
TICK_S = 60
"""Simulated time of a tick."""
TRAIL = 20
"""Cells of the trail behind a UAV."""
TERRAIN_Z = -1.0
"""The terrain lies a metre under the maps, so that they never fight for a pixel."""
BLOCKED_BY = {Block.GRID: "the edge of the grid", Block.OBSTACLE: "an obstacle", Block.UAV: "another UAV"}

Messages = Iterator[tuple[str, Any]]


@dataclass(frozen=True)
class Replayed:
    """What was written: the file, its layout beside it, and what it was made from."""

    path: Path
    layout: Path
    flown: Timeline


def default_path(folder: Path, episode: int) -> Path:
    """Where the replay file of an episode belongs."""
    return folder / "replay" / f"episode-{episode:06d}.mcap"


def write(folder: Path, episode: int, out: Path, show: Callable[[str], None] = lambda _: None) -> Replayed:
    """Write the replay file of an episode of a run, and its layout as `<out's stem>.layout.json`.

    `show` gets words of progress. RecordError when the log has nothing of the episode, or `out` cannot be written.
    """
    flown = timeline.read(folder, episode, show)
    topics: set[str] = set()
    with Export(out) as export:
        facts = {"format": FORMAT, "process": "replay", "clock": "simulated", "tick_seconds": str(TICK_S)}
        export.add_metadata("overfly/replay", facts | {"episode": str(episode), "ticks": str(flown.ticks)})
        for now in maps(flown):
            for topic, message in tick_messages(flown, now):
                export.write(topic, message, now.tick * TICK_NS)
                topics.add(topic)
            show(f"episode {episode}: tick {now.tick:,} of {flown.ticks:,}")
        text = _layout(flown, topics)
        export.attach(layout.FILE, "application/json", text.encode())
    beside = out.with_suffix(".layout.json")
    _write(beside, text)
    return Replayed(out, beside, flown)


def tick_messages(flown: Timeline, now: Maps) -> Messages:
    """(topic, message) of one tick; what is told once comes first at tick 0."""
    if now.tick == 0:
        yield from _once(flown)
    yield "/tmc/last_visit", _grid(flown.world, now, TRUE)
    yield "/tmc/tick", _team_tick(flown, now)
    present = np.flatnonzero(flown.cells[now.tick] != UNKNOWN).tolist()
    for uav in present:
        yield from _uav(flown, now, uav)
    yield "/scene", _scene(flown, now.tick, present)
    yield from _log(flown, now.tick, present)


def _once(flown: Timeline) -> Messages:
    world = flown.world
    yield "/tf", messages.world_to_map(0)
    terrain = np.where(world.map.blocked, 2, world.map.road).astype(np.uint8)
    message = builders.layers({"terrain": terrain}, world.grid.rows, world.grid.cols, world.map.cell_m, 0)
    message.pose.position.z = TERRAIN_Z
    yield "/map/terrain", message
    if flown.roads:
        yield "/map/roads", builders.geojson(flown.roads)


def _grid(world: World, now: Maps, row: int) -> Any:
    """The map in a row of the maps, over all cells; those that are not monitored are 0."""
    last_visit, uncertainty = np.zeros(world.grid.size, "<u4"), np.zeros(world.grid.size, "<f4")
    last_visit[world.law.cells], uncertainty[world.law.cells] = now.last_visit[row], now.uncertainty[row]
    fields: dict[str, NDArray[Any]] = {"last_visit": last_visit, "uncertainty": uncertainty}
    return builders.layers(fields, world.grid.rows, world.grid.cols, world.map.cell_m, now.tick * TICK_NS)


def _team_tick(flown: Timeline, now: Maps) -> Any:
    t, cells, sums = now.tick, flown.world.law.cells.size, now.sums
    return schemas.TeamTick(
        episode=flown.episode, tick=t, uncertainty=sums[TRUE], uncertainty_per_cell=sums[TRUE] / cells,
        believed=sums[TMC], believed_per_cell=sums[TMC] / cells, reward=flown.reward[t],
        blocked=int((flown.blocks[t] > 0).sum()), answered=len(flown.answered.get(t, [])),
        uavs=int((flown.cells[t] != UNKNOWN).sum()),
    )  # fmt: skip


def _uav(flown: Timeline, now: Maps, uav: int) -> Messages:
    t, cell = now.tick, int(flown.cells[now.tick, uav])
    yield uav_topic(uav, "belief"), _grid(flown.world, now, UAV + uav)
    at = place(flown.world, cell)
    yield uav_topic(uav, "pose"), messages.pose_in_frame(at, _heading(flown, t, uav), t * TICK_NS)
    lonlat = flown.world.map.lonlat(cell)
    if lonlat is not None:
        yield uav_topic(uav, "fix"), builders.location_fix(*lonlat, t * TICK_NS)
    believed = float(now.sums[UAV + uav])
    yield uav_topic(uav, "tick"), schemas.UavTick(
        uav=uav, episode=flown.episode, tick=t, cell=cell, action=int(flown.actions[t, uav]),
        block=int(flown.blocks[t, uav]), reward=float(flown.rewards[t, uav]), believed=believed,
        believed_per_cell=believed / flown.world.law.cells.size, exchanged=now.exchanged[uav],
        policy=int(flown.policies[t, uav]),
    )  # fmt: skip


def place(world: World, cell: int) -> messages.Point:
    """The centre of a cell in the frame of the grid: metres to the east and to the north of the south-west corner."""
    row, col = divmod(cell, world.grid.cols)
    return (col + 0.5) * world.map.cell_m, (world.grid.rows - row - 0.5) * world.map.cell_m


def _heading(flown: Timeline, t: int, uav: int) -> float:
    """The direction of the last move that was one, radians from the east to the north; east before the first."""
    cells = flown.cells[: t + 1, uav]
    moved = np.flatnonzero(np.diff(cells))
    if not moved.size:
        return 0.0
    _, d_row, d_col = ACTIONS[flown.actions[moved[-1] + 1, uav]]
    return math.atan2(-d_row, d_col)


def _scene(flown: Timeline, t: int, present: list[int]) -> Any:
    world, first = flown.world, max(0, t + 1 - TRAIL)
    entities = []
    for uav in present:
        trail = [place(world, cell) for cell in flown.cells[first : t + 1, uav].tolist()]
        colour, shape = palette.colour_of(uav), palette.round_of(uav)
        entities.append(messages.uav_entity(uav, trail, colour, shape, world.map.cell_m, t * TICK_NS))
    gone = (messages.entity_id(uav) for uav in range(flown.cells.shape[1]) if uav not in present)
    return messages.scene(entities, gone, t * TICK_NS)


def _log(flown: Timeline, t: int, present: list[int]) -> Messages:
    answered = flown.answered.get(t)
    if answered and flown.world.config.T_u > 1:  # at every tick it would be no news
        who = "all UAVs" if len(answered) == len(present) else f"UAV {', '.join(map(str, answered))}"
        yield "/log", _said("info", f"exchange with {who}", "tmc", t)
    for uav in present:
        if block := int(flown.blocks[t, uav]):
            text = f"its move {ACTIONS[flown.actions[t, uav]][0]} was blocked by {BLOCKED_BY[Block(block)]}"
            yield "/log", _said("warning", text, f"uav-{uav}", t)
        elif t == 0:
            yield "/log", _said("info", f"starts on cell {flown.cells[0, uav]}", f"uav-{uav}", t)


def _said(level: str, text: str, name: str, t: int) -> Any:
    return builders.log_message(level, f"tick {t}: {text}", name, t * TICK_NS)


def _layout(flown: Timeline, topics: set[str]) -> str:
    grid, team = flown.world.grid, flown.cells.shape[1]
    colours = [palette.colour_of(uav) for uav in range(team)]
    return json.dumps(layout.layout(topics, colours, grid.rows, grid.cols, flown.world.map.cell_m), indent=1) + "\n"


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise RecordError(f"{path} cannot be written ({error.strerror}): choose another place with --out") from None
