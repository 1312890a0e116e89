"""The schemas of the log: Overfly's protobuf types, built from a table, and foxglove's, imported when first used.

`overfly.proto` is the readable copy; a test compares the two. The number of a field is its position in the table, so
fields are only added at the end of a type, and every log stays readable.
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from tmc.record.errors import RecordError

PACKAGE = "overfly"

# Each field is "type name"; "*" marks a repeated one. overfly.proto describes the fields.
TYPES: dict[str, str] = {
    "FlightRecord": "uint32 uav, uint64 incarnation, uint64 sequence, uint32 episode, uint32 first, uint32 tick, "
    "uint64 version, uint64 policy, uint32* cells, uint32* actions, uint32* blocks, float* rewards, "
    "uint32* seen_tick, uint32* seen_cell, float* values",
    "Sync": "uint32 episode, uint32 tick, uint64 version, uint64 policy, uint32* uavs, double believed",
    "Episode": "uint32 episode, string phase, uint32* starts, uint32 ticks, double uncertainty, "
    "double uncertainty_per_cell, double* reward, uint64 blocked_grid, uint64 blocked_obstacle, uint64 blocked_uav, "
    "double epsilon, uint64 updates, uint64 steps",
    "Lost": "uint32 episode, uint32 uav, sint32 tick",
    "State": "uint32 episode, string map, string replay, uint64 transitions",
    "Events": "uint32 episode, uint32* ticks, uint32* cells",
    "TeamMetrics": "uint32 episode, uint32 first, uint64 steps, uint64 updates, uint64 policy, double* uncertainty, "
    "float* reward, double elapsed",
    "Policy": "uint64 version, uint64 updates, string sha256, double loss, bytes model",
    "LearnerMetrics": "uint64 updates, uint32 episode, uint64 steps, double loss, double q_mean, double target_mean, "
    "double td_abs, double grad_norm, double updates_per_second, double idle_share, double wall",
    "UavStatus": "uint32 uav, uint32 episode, uint32 tick, uint32 cell, double waited, double steps_per_second, "
    "uint32 explored, sint32 lead, uint32 lead_most, uint32 lead_tick, string lead_bound",
    "ObservationHashes": "uint32 uav, uint32 episode, uint32 first, uint32 tick, fixed64* hashes",
    "TeamTick": "uint32 episode, uint32 tick, double uncertainty, double uncertainty_per_cell, double believed, "
    "double believed_per_cell, double reward, uint32 blocked, uint32 answered, uint32 uavs",
    "UavTick": "uint32 uav, uint32 episode, uint32 tick, uint32 cell, uint32 action, uint32 block, double reward, "
    "double believed, double believed_per_cell, uint32 exchanged, uint64 policy",
}


def file_descriptor() -> Any:
    """Return the FileDescriptorProto of the table."""
    file = descriptor_pb2.FileDescriptorProto(name="overfly.proto", package=PACKAGE, syntax="proto3")
    for name, fields in TYPES.items():
        message = file.message_type.add(name=name)
        for number, text in enumerate(fields.split(", "), start=1):
            _add_field(message, number, *text.split(" "))
    return file


def _add_field(message: Any, number: int, kind: str, name: str) -> None:
    proto = descriptor_pb2.FieldDescriptorProto
    repeated = kind.endswith("*")
    message.field.add(
        name=name,
        number=number,
        type=proto.Type.Value(f"TYPE_{kind.rstrip('*').upper()}"),
        label=proto.LABEL_REPEATED if repeated else proto.LABEL_OPTIONAL,
    )


def _pool() -> Any:
    """Return a pool of Overfly's own, so that importing this module changes nothing global."""
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file_descriptor().SerializeToString())
    return pool


_POOL = _pool()


def _own(name: str) -> Any:
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"{PACKAGE}.{name}"))


FlightRecord = _own("FlightRecord")
Sync = _own("Sync")
Episode = _own("Episode")
Lost = _own("Lost")
State = _own("State")
Events = _own("Events")
TeamMetrics = _own("TeamMetrics")
Policy = _own("Policy")
LearnerMetrics = _own("LearnerMetrics")
UavStatus = _own("UavStatus")
ObservationHashes = _own("ObservationHashes")
TeamTick = _own("TeamTick")
UavTick = _own("UavTick")


@cache
def message_class(schema: str) -> Any:
    """Return the class of a schema, such as `overfly.Sync` or `foxglove.Grid`; RecordError when it is not known."""
    package, _, name = schema.partition(".")
    if package == PACKAGE and name in TYPES:
        return _own(name)
    if package == "foxglove" and name.isidentifier():
        try:
            return getattr(foxglove(name), name)
        except (ImportError, AttributeError):
            pass
    raise RecordError(f"schema {schema} is not known here: upgrade overfly and foxglove-schemas-protobuf")


def foxglove(name: str) -> Any:
    """Import the generated module of one foxglove type. Each import takes milliseconds, so only used ones are."""
    return importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")


def schema_bytes(schema: str) -> bytes:
    """Return what MCAP stores of a protobuf schema: a FileDescriptorSet with all types that it depends on."""
    files = descriptor_pb2.FileDescriptorSet()
    _collect(message_class(schema).DESCRIPTOR.file, files, set())
    return bytes(files.SerializeToString())


def _collect(file: Any, files: Any, done: set[str]) -> None:
    if file.name in done:
        return
    done.add(file.name)
    for dependency in file.dependencies:
        _collect(dependency, files, done)
    file.CopyToProto(files.file.add())
