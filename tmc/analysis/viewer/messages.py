"""Build the messages that viewers draw: poses, frames and the scene, in the grid's frame (metres, x east, y north).

Every field of a position is set, even to zero, since converters of viewers look for the sub-messages.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from tmc.record.builders import FRAME
from tmc.record.schemas import foxglove

if TYPE_CHECKING:  # importing each takes milliseconds: see schemas.foxglove
    from foxglove_schemas_protobuf.Color_pb2 import Color
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.Pose_pb2 import Pose
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
    from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

WORLD = "world"
"""The parent of the grid's frame; both have the same origin."""
SHAPES: tuple[tuple[str, dict[str, float]], ...] = (
    ("spheres", {}),
    ("cubes", {}),
    ("cylinders", {"bottom_scale": 1.0, "top_scale": 1.0}),
    ("cylinders", {"bottom_scale": 1.0, "top_scale": 0.0}),
)
"""Shapes of UAVs; UAVs of the same colour differ by shape. A field of SceneEntity, and fields of the shape."""
HEIGHT_CELLS = 0.5
"""Height of UAVs and their trails above the map, in cell widths. The UAV with the lowest id is highest."""
Point = tuple[float, float]


def pose_in_frame(at: Point, yaw: float, time_ns: int) -> PoseInFrame:
    """Return a foxglove.PoseInFrame. `yaw`: radians, from east to north."""
    message: PoseInFrame = foxglove("PoseInFrame").PoseInFrame(frame_id=FRAME)
    message.timestamp.FromNanoseconds(time_ns)
    _place(message.pose, at, 0.0, yaw)
    return message


def world_to_map(time_ns: int) -> FrameTransform:
    """Return the foxglove.FrameTransform that viewers need once: the identity."""
    transform = foxglove("FrameTransform").FrameTransform
    message: FrameTransform = transform(parent_frame_id=WORLD, child_frame_id=FRAME)
    message.timestamp.FromNanoseconds(time_ns)
    message.translation.x = message.translation.y = message.translation.z = 0.0
    message.rotation.w = 1.0
    return message


def scene(entities: Iterable[SceneEntity], gone: Iterable[str], time_ns: int) -> SceneUpdate:
    """Return a foxglove.SceneUpdate that replaces `entities` and deletes those with an id in `gone`."""
    message: SceneUpdate = foxglove("SceneUpdate").SceneUpdate(entities=entities)
    matching = foxglove("SceneEntityDeletion").SceneEntityDeletion.MATCHING_ID
    for name in gone:
        message.deletions.add(type=matching, id=name).timestamp.FromNanoseconds(time_ns)
    return message


def uav_entity(uav: int, trail: Sequence[Point], colour: str, shape: int, cell_m: float, time_ns: int) -> SceneEntity:
    """Return a foxglove.SceneEntity `uav-<id>`: a body at the last point of the trail, its number, and the trail.

    `trail`: points, metres. `colour`: `#RRGGBB`. `shape`: index in SHAPES, modulo its length.
    """
    entity: SceneEntity = foxglove("SceneEntity").SceneEntity(frame_id=FRAME, id=entity_id(uav))
    entity.timestamp.FromNanoseconds(time_ns)
    entity.lifetime.FromNanoseconds(0)  # until it is replaced or deleted
    z = HEIGHT_CELLS * cell_m / (1 + uav / 100)
    x, y = trail[-1]
    kind, scales = SHAPES[shape % len(SHAPES)]
    body = getattr(entity, kind).add(**scales)
    _place(body.pose, (x, y), z)
    body.size.x = body.size.y = body.size.z = 0.7 * cell_m
    _paint(body.color, colour)
    text = entity.texts.add(billboard=True, font_size=18, scale_invariant=True, text=str(uav))
    _place(text.pose, (x + 0.6 * cell_m, y + 0.6 * cell_m), z)
    _paint(text.color, "#000000")
    line = entity.lines.add(type=foxglove("LinePrimitive").LinePrimitive.LINE_STRIP, thickness=4, scale_invariant=True)
    _place(line.pose, (0.0, 0.0), 0.0)
    for px, py in trail:
        line.points.add(x=px, y=py, z=z)
    _paint(line.color, colour)
    return entity


def entity_id(uav: int) -> str:
    """Return the id of a UAV in the scene."""
    return f"uav-{uav}"


def _place(pose: Pose, at: Point, z: float, yaw: float = 0.0) -> None:
    pose.position.x, pose.position.y, pose.position.z = *at, z
    pose.orientation.z, pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)


def _paint(color: Color, colour: str) -> None:
    """Set a colour, given as `#RRGGBB`."""
    color.r, color.g, color.b = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    color.a = 1.0
