"""The codec: whatever arrives, `decode` gives a intact message or a CodecError, and never much memory for few bytes."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tmc.wire.codec import HEADER_LIMIT_BYTES, CodecError, decode, encode
from tmc.wire.messages import EMPTY, MESSAGES, PROTOCOL, Error, Map, Message, Minibatch, Policy, PolicyRequest, Status

QUICK = settings(max_examples=60, deadline=None)
Same = Callable[[Message, Message], bool]
BATCH = Minibatch(
    1, 0, 0, np.zeros(4, "<u2"), np.zeros((4, 1), "<u2"), np.zeros((4, 5), "<f4"),
    np.zeros(2, "u1"), np.zeros(2, "<f4"), np.zeros(2, "<f4"), np.ones((2, 9), "u1"), np.arange(2),
    np.ones(2, "<f4"),
)  # fmt: skip
ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=5,
)


def as_bytes(message: Message) -> list[bytes]:
    """The frames as the other side gets them."""
    return [f if isinstance(f, bytes) else f.tobytes() for f in encode(message)]


def header(**values: Any) -> bytes:
    packed: bytes = msgpack.packb({"v": PROTOCOL, **values})
    return packed


def with_header(message: Message, **changes: Any) -> list[bytes]:
    """The frames of a message with entries of its header replaced; ... removes one."""
    first, *rest = as_bytes(message)
    values = {**msgpack.unpackb(first), **changes}
    return [msgpack.packb({k: v for k, v in values.items() if v is not ...}), *rest]


def refused(frames: list[Any]) -> CodecError:
    """The error; its code and text must make a reply that can be sent, whatever was in the frames."""
    with pytest.raises(CodecError) as caught:
        decode(frames)
    decode(encode(Error(caught.value.code, str(caught.value))))
    return caught.value


def survives(frames: list[Any], same: Same) -> None:
    """A intact message, which makes the same journey again, or a CodecError: nothing else."""
    try:
        message = decode(frames)
    except CodecError as error:
        decode(encode(Error(error.code, str(error))))
        return
    assert type(message) in MESSAGES
    assert same(decode(as_bytes(message)), message)


# Whatever arrives


@QUICK
@given(frames=st.lists(st.binary(max_size=60), max_size=4))
def test_arbitrary_frames(frames: list[bytes], same: Same) -> None:
    survives(frames, same)


@QUICK
@given(value=ANYTHING, rest=st.lists(st.binary(max_size=8), max_size=3))
def test_arbitrary_msgpack(value: Any, rest: list[bytes], same: Same) -> None:
    survives([msgpack.packb(value), *rest], same)


@QUICK
@given(cls=st.sampled_from(MESSAGES), extra=st.dictionaries(st.text(max_size=6), ANYTHING, max_size=3), data=st.data())
def test_arbitrary_values_in_known_fields(
    cls: type[Message], extra: dict[str, Any], data: st.DataObject, same: Same
) -> None:
    named = {name: data.draw(ANYTHING) for name in cls.__dataclass_fields__}
    survives([header(type=cls.__name__, **{**extra, **named})], same)


@settings(QUICK, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_mutated_frames(any_message: st.SearchStrategy[Message], same: Same, data: st.DataObject) -> None:
    """Bytes changed, cut out, doubled or put in; frames lost, doubled or swapped."""
    frames = as_bytes(data.draw(any_message))
    for _ in range(data.draw(st.integers(1, 4))):
        which = data.draw(st.integers(0, len(frames) - 1))
        frame = frames[which]
        a, b = sorted(data.draw(st.tuples(*[st.integers(0, len(frame))] * 2)))
        frames[which] = data.draw(
            st.sampled_from([
                frame[:a] + frame[b:], frame[:b] + frame[a:], frame[:a] + data.draw(st.binary(max_size=6)) + frame[a:],
                frame[:a], frame[a:], bytes(reversed(frame)),
            ])
        )  # fmt: skip
        other = data.draw(st.integers(0, len(frames) - 1))
        if data.draw(st.booleans()):
            frames[which], frames[other] = frames[other], frames[which]
        elif data.draw(st.booleans()):
            frames.insert(other, frames[which])
    survives(frames, same)


@settings(QUICK, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_one_flipped_bit(any_message: st.SearchStrategy[Message], same: Same, data: st.DataObject) -> None:
    first, *rest = as_bytes(data.draw(any_message))
    flipped = bytearray(first)
    flipped[data.draw(st.integers(0, len(first) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    survives([bytes(flipped), *rest], same)


# The envelope


@pytest.mark.parametrize("frames", [[], [b""], [b"", b"x"], [b"\xc1"], [b"\x00"], [b"\x90"], [b"\xc0"], [b"\xa3uav"]])
def test_what_is_no_map_is_malformed(frames: list[bytes]) -> None:
    assert refused(frames).code == "malformed"


@pytest.mark.parametrize("tail", [b"\x00", b"\x80", b"\xc1"])
def test_bytes_after_the_map_are_malformed(tail: bytes) -> None:
    assert refused([as_bytes(PolicyRequest(1))[0] + tail]).code == "malformed"


def test_every_cut_header_is_malformed() -> None:
    whole = as_bytes(Status("flying", 1, 2, 3, 4, 5, 0.5, 1.0, 1.0, 0, 0, "uav-001"))[0]
    assert {refused([whole[:n]]).code for n in range(len(whole))} == {"malformed"}


@pytest.mark.parametrize("version", [0, 1, PROTOCOL + 1, -1, 2**63, True, 1.0, "1", None, [1], b"1", ...])
def test_a_foreign_version_is_refused_before_anything_else(version: Any) -> None:
    values = {} if version is ... else {"v": version}
    error = refused([msgpack.packb({"type": "Nonsense", "junk": 1, **values})])
    assert error.code == "version"
    assert f"use version {PROTOCOL}" in str(error)


@pytest.mark.parametrize("name", ["", "hello", "Message", "object", "x" * 5000, None, 1, True, [1], ...])
def test_an_unknown_type_is_refused(name: Any) -> None:
    values = {} if name is ... else {"type": name}
    assert refused([header(**values)]).code == "unknown"


@pytest.mark.parametrize(
    "raw", [b"\x81\x01\x02", b"\x81\xc4\x01v\x01", b"\x81\xc0\x01", b"\x81\x90\x01", b"\x81\xc3\x01"]
)
def test_keys_are_strings(raw: bytes) -> None:
    assert refused([raw]).code == "malformed"


def test_a_header_over_the_limit_is_not_unpacked() -> None:
    too_long = header(type="Policy", version=1, junk=bytes(HEADER_LIMIT_BYTES))
    tracemalloc.start()
    assert refused([too_long]).code == "malformed"
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < HEADER_LIMIT_BYTES / 4


@pytest.mark.parametrize("kind", ["list", "map"])
@pytest.mark.parametrize("entries", [65, 1000, 2**31])
def test_long_lists_and_maps_are_refused(kind: str, entries: int) -> None:
    """Also when they only announce a length."""
    first = {"list": b"\xdd", "map": b"\xdf"}[kind] + entries.to_bytes(4, "big")
    assert refused([b"\x81\xa1v" + first]).code == "malformed"
    assert refused([first + bytes(2 * min(entries, 1000))]).code == "malformed"


@pytest.mark.parametrize("place", ["v", "type", "version", "junk"])
@pytest.mark.parametrize("depth", [100, 900, 1000, 1020, 1100, 100_000])
@pytest.mark.parametrize("opener", [b"\x91", b"\x81\xa1a"], ids=["lists", "maps"])
def test_nested_values_are_refused(place: str, depth: int, opener: bytes) -> None:
    """Wherever they stand and however deep they are."""
    entries = {"v": bytes([PROTOCOL]), "type": b"\xadPolicyRequest", "version": b"\x01"}
    entries[place] = opener * depth + b"\xc0"
    packed = b"".join(msgpack.packb(key) + value for key, value in entries.items())
    assert refused([bytes([0x80 + len(entries)]) + packed]).code in {"malformed", "version", "unknown"}


def test_a_bomb_of_empty_maps_does_not_fill_the_memory() -> None:
    """260,000 empty maps in 280 kB, in lists of 64 in lists of 64: a megabyte of them would be 70 MB of objects."""
    bomb = b"\x80"
    for _ in range(3):
        bomb = b"\xdc\x00\x40" + bomb * 64
    frame = b"\x83\xa1v" + bytes([PROTOCOL]) + b"\xa4type\xadPolicyRequest\xa7version" + bomb
    tracemalloc.start()
    assert refused([frame]).code == "malformed"
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * len(frame)


@pytest.mark.parametrize("code", [-1, 0, 1, 127])
@pytest.mark.parametrize("size", [0, 1, 4, 8, 12, 16])
def test_ext_types_are_refused(code: int, size: int) -> None:
    """Timestamps (-1) too."""
    ext = b"\xc7" + bytes([size, code % 256]) + bytes(size)
    frame = b"\x83\xa1v" + bytes([PROTOCOL]) + b"\xa4type\xadPolicyRequest\xa7version" + ext
    assert refused([frame]).code == "malformed"


def test_text_that_is_no_utf_8_is_refused() -> None:
    assert refused([b"\x83\xa1v" + bytes([PROTOCOL]) + b"\xa4type\xa3End\xa6reason\xa1\xff"]).code == "malformed"


# Fields


@pytest.mark.parametrize(
    ("value", "code"),
    [(True, "malformed"), (None, "malformed"), (1.0, "malformed"), ("1", "malformed"), ([1], "malformed"),
     ({}, "malformed"), (float("nan"), "malformed"), (-1, "range"), (2**62 + 1, "range"), (2**64 - 1, "range")],
)  # fmt: skip
def test_an_int_is_an_int_in_range(value: Any, code: str) -> None:
    assert refused([header(type="PolicyRequest", version=value)]).code == code


@pytest.mark.parametrize(
    ("value", "code"),
    [(float("nan"), "malformed"), (float("inf"), "malformed"), (1, "malformed"), (True, "malformed"),
     (None, "malformed"), (1e31, "range")],
)  # fmt: skip
def test_a_float_is_finite(value: Any, code: str) -> None:
    status = Status("flying", 1, 2, 3, 4, 5, 0.5, 1.0, 1.0, 0, 0, "")
    assert refused(with_header(status, loss=value)).code == code


@pytest.mark.parametrize("value", [None, 7, "ab", [1, 2], b"abc", {"a": 1}, True])
def test_an_array_is_bytes_of_whole_entries(value: Any) -> None:
    assert refused(with_header(Map(1, 2, 3, 4, 5, 5, EMPTY, EMPTY), last_visit=value)).code == "malformed"


def test_an_array_longer_than_its_rule_is_out_of_range() -> None:
    frames = with_header(Map(1, 2, 3, 4, 5, 5, EMPTY, EMPTY), last_visit=bytes(2 * 65_536))
    assert refused(frames).code == "range"


@pytest.mark.parametrize("cls", MESSAGES, ids=lambda c: c.__name__)
def test_missing_fields_are_named_or_refused(cls: type[Message]) -> None:
    if cls.__dataclass_fields__:
        error = refused([header(type=cls.__name__)])
        assert error.code == "malformed"
        assert next(iter(cls.__dataclass_fields__)) in str(error)


@pytest.mark.parametrize("name", ["request", "ticks", "u", "allowed"])
def test_each_field_of_a_minibatch_must_be_there(name: str) -> None:
    assert refused(with_header(BATCH, **{name: ...})).code == "malformed"


def test_unknown_fields_are_refused() -> None:
    assert refused(with_header(PolicyRequest(1), colour="red")).code == "malformed"


@pytest.mark.parametrize("value", [None, 1, [1], "onnx", b""])
def test_a_header_entry_for_a_frame_of_its_own_is_refused(value: Any) -> None:
    """A blob stands in its frame only; an entry of the same name in the header is one too many."""
    assert refused(with_header(Policy(1, b"onnx"), model=value)).code == "malformed"


# Frames


def test_missing_and_extra_frames_are_refused() -> None:
    frames = as_bytes(BATCH)
    for n in range(1, len(frames)):
        assert refused(frames[:n]).code == "malformed"
    assert refused([*frames, b""]).code == "malformed"
    assert refused([*as_bytes(PolicyRequest(1)), b"x"]).code == "malformed"


@pytest.mark.parametrize(
    "shape",
    [
        None, 7, "4,5", b"", {}, [], [4], [4, 5, 1], [4, 6], [0, 5], [4, -5], [4, 5.0], [True, 20], [4, None], [4, "5"],
        [-4, -5], [2**31, 0], [2**31 - 1, 2**31 - 1], [2**63, 1],
    ],
    ids=str,
)  # fmt: skip
def test_a_shape_that_does_not_fit_its_frame_is_refused(shape: Any) -> None:
    assert refused(with_header(BATCH, u=shape)).code == "malformed"


@pytest.mark.parametrize("change", [-4, -1, 1, 4])
def test_a_frame_of_another_size_is_refused(change: int) -> None:
    for i in range(1, len(as_bytes(BATCH))):
        frames = as_bytes(BATCH)
        frames[i] = frames[i][:change] if change < 0 else frames[i] + bytes(change)
        assert refused(frames).code == "malformed"


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_tensor_is_finite(number: float) -> None:
    frames = as_bytes(BATCH)
    poisoned = np.frombuffer(frames[3], "<f4").copy()
    poisoned[-1] = number
    frames[3] = poisoned.tobytes()
    assert refused(frames).code == "range"


# What goes out


def test_large_arrays_are_neither_copied_on_the_way_out_nor_in() -> None:
    frames = encode(BATCH)
    assert np.shares_memory(frames[3], BATCH.u)
    decoded = decode(frames)
    assert isinstance(decoded, Minibatch)
    assert np.shares_memory(decoded.u, BATCH.u)


def test_arrays_that_lie_otherwise_in_memory_arrive_in_order() -> None:
    maps = np.arange(20, dtype="<f4").reshape(5, 4).T
    batch = dataclasses.replace(BATCH, u=maps)
    decoded = decode(as_bytes(batch))
    assert isinstance(decoded, Minibatch)
    assert (decoded.u == maps).all()


def test_a_frame_names_its_type_and_version() -> None:
    values = msgpack.unpackb(as_bytes(PolicyRequest(7))[0])
    assert values == {"type": "PolicyRequest", "v": PROTOCOL, "version": 7}
