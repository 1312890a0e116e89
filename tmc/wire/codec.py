"""Encode messages as frames, and decode them. The first frame is a msgpack map; each large field has its own frame.

Frames are untrusted. Sizes are limited before anything is unpacked, and every field is checked. `decode` returns a
valid message or raises CodecError, with the code of the error reply.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgpack
import numpy as np

from tmc.wire import fields
from tmc.wire.messages import MESSAGES, PROTOCOL, Message

HEADER_LIMIT_BYTES = 5 * 1024 * 1024
"""Largest first frame. A flight record of the longest episode fits."""
_TYPES = {cls.__name__: cls for cls in MESSAGES}
_FRAMED = ("tensor", "bytes")


class CodecError(ValueError):
    """Frames are not a valid message. `code` is one of the codes of `Error`."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


def encode(message: Message) -> list[Any]:
    """Return the frames of a message: bytes, and contiguous arrays, which ZeroMQ sends without a copy."""
    header: dict[str, Any] = {"type": type(message).__name__, "v": PROTOCOL}
    frames: list[Any] = []
    for name, rule in fields.rules(type(message)).items():
        value = getattr(message, name)
        if rule.kind == "array":
            header[name] = value.tobytes()
        elif rule.kind == "tensor":
            header[name] = list(value.shape)
            frames.append(np.ascontiguousarray(value))
        elif rule.kind == "bytes":
            frames.append(value)
        else:
            header[name] = value
    return [msgpack.packb(header), *frames]


def decode(frames: Sequence[Any]) -> Message:
    """Return the message in these frames (bytes or buffers). Raises CodecError."""
    header = _header(frames)
    cls = _message_class(header)
    values: dict[str, Any] = {}
    rest = iter(frames[1:])
    for name, rule in fields.rules(cls).items():
        present = name in header
        raw = header.pop(name, None)
        if rule.kind == "bytes" and present:
            raise CodecError("malformed", f"{cls.__name__}.{name} belongs into a frame of its own")
        if rule.kind in _FRAMED:
            raw = _frame(rest, name, raw, rule)
        elif rule.kind == "array":
            raw = _array(raw, name, rule)
        elif not present:
            raise CodecError("malformed", f"{cls.__name__}.{name} is missing")
        values[name] = raw
    if header or next(rest, None) is not None:
        raise CodecError("malformed", f"{cls.__name__} has fields or frames that it should not have")
    try:
        return cls(**values)
    except fields.FieldError as error:
        raise CodecError(error.code, str(error)) from None


def _header(frames: Sequence[Any]) -> dict[str, Any]:
    if not frames or len(frames[0]) > HEADER_LIMIT_BYTES:
        raise CodecError("malformed", f"the first frame must have 1 to {HEADER_LIMIT_BYTES} bytes")
    try:
        header = msgpack.unpackb(
            frames[0], strict_map_key=True, max_map_len=64, max_array_len=8, max_ext_len=0,
            object_pairs_hook=_flat_map, list_hook=_flat_list,
        )  # fmt: skip
    except Exception:  # msgpack raises many types, ValueError and RecursionError among them
        raise CodecError("malformed", "the first frame is not a msgpack map within the limits") from None
    if not isinstance(header, dict) or not all(isinstance(k, str) for k in header):
        raise CodecError("malformed", "the first frame is not a msgpack map with string keys")
    return header


def _flat_map(pairs: list[tuple[Any, Any]]) -> dict[str, Any]:
    """Return the header; refuse a map inside it, since nested empty maps unpack to a hundred times their size."""
    if any(isinstance(value, dict) for _, value in pairs):
        raise ValueError("a map inside the header")
    return dict(pairs)


def _flat_list(items: list[Any]) -> list[Any]:
    """Return a shape; refuse anything but ints in it, for the same reason."""
    if any(type(item) is not int for item in items):
        raise ValueError("a list of values other than ints")
    return items


def _message_class(header: dict[str, Any]) -> type[Message]:
    version, name = header.pop("v", None), header.pop("type", None)
    if type(version) is not int or version != PROTOCOL:
        raise CodecError("version", f"protocol version {str(version)[:20]!r} is not supported: use version {PROTOCOL}")
    if not isinstance(name, str) or name not in _TYPES:
        raise CodecError("unknown", f"there is no message type {str(name)[:40]!r}")
    return _TYPES[name]


def _frame(rest: Any, name: str, shape: Any, rule: fields.Rule) -> Any:
    data = next(rest, None)
    if data is None:
        raise CodecError("malformed", f"the frame of {name} is missing")
    if rule.kind == "bytes":
        return bytes(data)
    dtype = np.dtype(rule.dtype)
    if (
        not isinstance(shape, list)
        or len(shape) != rule.ndim
        or not all(type(n) is int and 0 <= n < 2**31 for n in shape)
    ):
        raise CodecError("malformed", f"the shape of {name} must be {rule.ndim} ints")
    count = 1
    for n in shape:
        count *= n
    if count * dtype.itemsize != memoryview(data).nbytes:
        raise CodecError("malformed", f"the frame of {name} does not have the size of its shape")
    return np.frombuffer(data, dtype).reshape(shape)


def _array(raw: Any, name: str, rule: fields.Rule) -> Any:
    dtype = rule.numpy
    if not isinstance(raw, bytes) or len(raw) % dtype.itemsize:
        raise CodecError("malformed", f"{name} must be bytes of {rule.dtype} entries")
    return np.frombuffer(raw, dtype)
