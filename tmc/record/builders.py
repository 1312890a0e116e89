"""Build the messages of the log from what the services hold, and convert them back."""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.text import printable
from tmc.record.errors import RecordError
from tmc.record.overfly_pb2 import FlightRecord
from tmc.record.schemas import foxglove
from tmc.wire.fields import FieldError
from tmc.wire.messages import Record

if TYPE_CHECKING:  # importing each takes milliseconds: see schemas.foxglove
    from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
    from foxglove_schemas_protobuf.Grid_pb2 import Grid
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
    from foxglove_schemas_protobuf.Log_pb2 import Log

FRAME = "map"
"""The frame of the grid: origin in its south-west corner, x east, y north, metres."""

LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "fatal": 5}
"""Levels of foxglove.Log by name."""

NUMERIC = {"|u1": "UINT8", "<u4": "UINT32", "<f4": "FLOAT32"}
"""Types of the fields of a Grid, by NumPy's name."""
_KINDS = {name: kind for kind, name in NUMERIC.items()}

_NUMBERS = ("uav", "incarnation", "sequence", "episode", "first", "tick", "version", "policy")
_ARRAYS = {
    "cells": "<u2", "actions": "u1", "blocks": "u1", "rewards": "<f4", "seen_tick": "<u2", "seen_cell": "<u2",
    "values": "<f4",
}  # fmt: skip
_CODES = {"<u2": "H", "u1": "B", "<f4": "f"}


def flight_record(record: Record) -> FlightRecord:
    """Return the overfly.FlightRecord of a Record, without `sent`; `to_record` is the inverse."""
    numbers = {name: getattr(record, name) for name in _NUMBERS}
    return FlightRecord(**numbers, **{name: getattr(record, name).tolist() for name in _ARRAYS})


def record_digest(record: Record) -> str:
    """Return the BLAKE2b (hex, 128 bits) of a flight record without the incarnation of the UAV that sent it."""
    numbers = " ".join(str(getattr(record, name)) for name in _NUMBERS if name != "incarnation")
    arrays = (getattr(record, name).tobytes() for name in _ARRAYS)
    return hashlib.blake2b(b"".join((numbers.encode(), *arrays)), digest_size=16).hexdigest()


def to_record(proto: FlightRecord) -> Record:
    """Return the Record of an overfly.FlightRecord; RecordError when a value is not valid in a Record."""
    values: dict[str, Any] = {name: getattr(proto, name) for name in _NUMBERS}
    try:
        values |= {name: _array(getattr(proto, name), kind) for name, kind in _ARRAYS.items()}
        return Record(**values)
    except FieldError as error:
        raise RecordError(
            f"a flight record of UAV {proto.uav} is not intact, so do not use this log: {error}"
        ) from None


def _array(values: Sequence[float], kind: str) -> NDArray[Any]:
    try:
        return np.array(array(_CODES[kind], values[:]), kind)  # checks the range, and is faster than NumPy
    except OverflowError:
        raise FieldError("range", f"a value does not fit {kind}") from None


def grid(last_visit: NDArray[np.integer], rows: int, cols: int, cell_m: float, time_ns: int) -> Grid:
    """Return a foxglove.Grid of the ticks of the last visits, shape (K,), uint32; `last_visit` is the inverse.

    `cell_m`: size of a cell, metres. `time_ns`: its timestamp. RecordError as `layers`.
    """
    return layers({"last_visit": last_visit.astype("<u4")}, rows, cols, cell_m, time_ns)


def layers(fields: Mapping[str, NDArray[Any]], rows: int, cols: int, cell_m: float, time_ns: int) -> Grid:
    """Return a foxglove.Grid with these fields, each of shape (K,) and of a dtype of NUMERIC; `layer` is the inverse.

    `cell_m`: size of a cell, metres. The rows are reversed: those of a Grid go north, ours go south. RecordError when
    a field does not have rows * cols values.
    """
    for values in fields.values():
        if values.shape != (rows * cols,):
            raise RecordError(f"a grid of {rows} x {cols} cells needs {rows * cols} values, not {values.shape}")
    cells = np.empty(rows * cols, [(name, values.dtype) for name, values in fields.items()])
    for name, values in fields.items():
        cells[name] = values
    message: Grid = foxglove("Grid").Grid(
        frame_id=FRAME,
        column_count=cols,
        cell_stride=cells.itemsize,
        row_stride=cells.itemsize * cols,
        data=cells.reshape(rows, cols)[::-1].tobytes(),
    )
    message.timestamp.FromNanoseconds(time_ns)
    # Converters look for the sub-messages of a pose, and protobuf leaves out those that are all zero.
    message.pose.position.SetInParent()
    message.pose.orientation.w = 1.0
    message.cell_size.x = message.cell_size.y = cell_m
    numeric = foxglove("PackedElementField").PackedElementField.NumericType
    for name, (dtype, offset, *_) in (cells.dtype.fields or {}).items():
        message.fields.add(name=name, offset=offset, type=numeric.Value(NUMERIC[dtype.str]))
    return message


def layer(message: Grid, name: str) -> NDArray[Any]:
    """Return the field `name` of a Grid, shape (K,), as given to `layers`; RecordError when there is none."""
    names = [field.name for field in message.fields]
    if name not in names:
        raise RecordError(f"the grid has no field {name}: it has {', '.join(names)}")
    field = message.fields[names.index(name)]
    kind = np.dtype(_KINDS[foxglove("PackedElementField").PackedElementField.NumericType.Name(field.type)])
    cells = np.frombuffer(message.data, np.uint8).reshape(-1, message.cell_stride)
    values = cells[:, field.offset : field.offset + kind.itemsize].copy().view(kind)
    return np.asarray(values.reshape(-1, message.column_count)[::-1].ravel())


def last_visit(message: Grid) -> NDArray[np.uint32]:
    """Return the ticks of the last visits, shape (K,), uint32, as given to `grid`."""
    return layer(message, "last_visit")


def location_fix(lon: float, lat: float, time_ns: int, frame: str = FRAME, altitude: float = 0.0) -> LocationFix:
    """Return a foxglove.LocationFix: degrees (WGS 84), altitude in metres."""
    fix = foxglove("LocationFix").LocationFix
    message: LocationFix = fix(frame_id=frame, latitude=lat, longitude=lon, altitude=altitude)
    message.timestamp.FromNanoseconds(time_ns)
    return message


def geojson(text: str) -> GeoJSON:
    """Return a foxglove.GeoJSON of a GeoJSON document."""
    message: GeoJSON = foxglove("GeoJSON").GeoJSON(geojson=text)
    return message


def log_message(level: str, text: str, name: str, time_ns: int) -> Log:
    """Return a foxglove.Log; `name` is the process that writes it. RecordError when the level is not in LEVELS."""
    if level not in LEVELS:
        raise RecordError(f"there is no log level {level!r}: choose one of {', '.join(LEVELS)}")
    message: Log = foxglove("Log").Log(level=LEVELS[level], message=printable(text), name=printable(name))
    message.timestamp.FromNanoseconds(time_ns)
    return message
