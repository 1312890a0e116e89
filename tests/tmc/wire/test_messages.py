"""Every message: frozen, valid by construction, and the same after the journey. Each field's rule is enforced."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tmc.wire import fields
from tmc.wire import messages as m
from tmc.wire.codec import decode, encode
from tmc.wire.fields import FRAME_LIMIT_BYTES
from tmc.wire.messages import EMPTY, MESSAGES, Message

QUICK = settings(max_examples=15, deadline=None)
Valid = Callable[[type[Message]], st.SearchStrategy[Message]]
Same = Callable[[Message, Message], bool]
IDS = [cls.__name__ for cls in MESSAGES]


def numbers(dtype: str, *values: float) -> NDArray[Any]:
    return np.array(values, dtype)


MAPS = np.arange(4 * 5, dtype="<f4").reshape(4, 5)
EXAMPLES: tuple[Message, ...] = (
    m.Hello("uav", 2, 12345),
    m.Hello("learner", -1, 2**63 - 1, updates=7),
    m.Welcome('{"team.size": 3}', "ab" * 32, "run-1", "/tmp/tracks", 4),
    m.Begin(
        episode=1, tick=1, shipped=-1, sequence=0, version=0, policy=1,
        last_visit=numbers("<u2", 0, 1), track=numbers("<u2", 17, 18), lost=EMPTY,
    ),
    m.Record(
        2, 12345, 3, 1, 1, 2, 5, 4, numbers("<u2", 7, 8), numbers("u1", 3, 8), numbers("u1", 0, 1),
        numbers("<f4", 1.5, -20), numbers("<u2", 2), numbers("<u2", 9),
    ),
    m.Record(
        2, 12345, 4, 1, 3, 3, 5, 4, numbers("<u2", 7), numbers("u1", 8), numbers("u1", 0), numbers("<f4", 1.5),
        EMPTY, EMPTY, values=numbers("<f4", 0.25, 2.5),
    ),
    m.Map(1, 10, 5, 4, 3, 2, numbers("<u2", 0, 10, 3), EMPTY),
    m.Alive(1, 12345, 40, -1, 7),
    m.Lost(2, 1, 30),
    m.PolicyRequest(4),
    m.Policy(4, b"\x08\x01onnx\x00"),
    m.SampleRequest(9),
    m.SampleRequest(10, numbers("<i8", 3, 2**40), numbers("<f4", 0.5, 7)),
    m.Minibatch(
        9, 0, 100, numbers("<u2", 4, 5, 6, 7), np.arange(8, dtype="<u2").reshape(4, 2), MAPS, numbers("u1", 1, 8),
        numbers("<f4", 1, 2), numbers("<f4", 0.9, 0.9), np.ones((2, 9), "u1"), numbers("<i8", 0, 2**40),
    ),
    m.Minibatch(
        9, 0, 100, numbers("<u2", 4, 6), np.zeros((2, 0), "<u2"), MAPS[:2], numbers("u1", 1), numbers("<f4", 1),
        numbers("<f4", 0.9), np.ones((1, 9), "u1"), numbers("<i8", 2**40), weight=numbers("<f4", 0.5),
    ),
    m.PolicyPush(5, 100, 0.25, b"onnx"),
    m.Ack(5),
    m.Beacon(0, 1, 3, numbers("<u2", 4, 5), numbers("<u2", 1, 2)),
    m.Beacon(0, 1, 3, EMPTY, EMPTY, ask=3),
    m.StatusRequest(),
    m.Status("flying", 1, 10, 30, 5, 2, 0.5, 12.25, 13.0, 1, 0, "uav-001"),
    m.End("the mission is over"),
    m.Bye("uav", 2, "SIGTERM"),
    m.Error("range", "Record.tick is out of range"),
)  # fmt: skip


def every_field(*kinds: str) -> list[Any]:
    return [
        pytest.param(cls, name, rule, id=f"{cls.__name__}.{name}")
        for cls in MESSAGES
        for name, rule in fields.rules(cls).items()
        if rule.kind in kinds
    ]


def example_of(cls: type[Message]) -> Message:
    return next(e for e in EXAMPLES if type(e) is cls)


def test_every_message_has_an_example() -> None:
    assert {type(e) for e in EXAMPLES} == set(MESSAGES)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_example_is_the_same_after_the_journey(message: Message, same: Same) -> None:
    assert same(decode([bytes(frame) for frame in encode(message)]), message)


@pytest.mark.parametrize("cls", MESSAGES, ids=IDS)
@QUICK
@given(data=st.data())
def test_any_message_is_the_same_after_the_journey(
    cls: type[Message], valid: Valid, same: Same, data: st.DataObject
) -> None:
    message = data.draw(valid(cls))
    frames = encode(message)
    assert same(decode([f if isinstance(f, bytes) else f.tobytes() for f in frames]), message)
    assert same(decode([memoryview(bytes(f)) for f in frames]), message)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_frames_decode_in_the_process_that_made_them(message: Message, same: Same) -> None:
    """`encode` gives large arrays as they are, and `decode` takes any buffer."""
    assert same(decode(encode(message)), message)


def test_an_empty_minibatch_decodes_in_the_process_that_made_it(same: Same) -> None:
    """Python cannot cast a view of an empty array with several dimensions."""
    cells, peers, none = numbers("<u2"), np.zeros((0, 2), "<u2"), numbers("<f4")
    rest = (none, none, np.ones((0, 9), "u1"), np.zeros(0, "<i8"))
    empty = m.Minibatch(9, 0, 100, cells, peers, MAPS[:0], numbers("u1"), *rest)
    assert same(decode([bytes(frame) for frame in encode(empty)]), empty)
    assert same(decode(encode(empty)), empty)


@pytest.mark.parametrize("cls", MESSAGES, ids=IDS)
def test_messages_are_frozen_documented_and_flat(cls: type[Message]) -> None:
    assert dataclasses.is_dataclass(cls)
    assert cls.__dataclass_params__.frozen  # type: ignore[attr-defined]
    assert cls.__doc__
    assert not cls.__doc__.startswith(f"{cls.__name__}(")
    assert set(fields.rules(cls)) == {f.name for f in dataclasses.fields(cls)}


def test_names_are_unique_and_exported() -> None:
    assert len(set(IDS)) == len(MESSAGES)
    assert set(IDS) <= set(m.__all__)


# Each field's rule


def refused(cls: type[Message], name: str, value: Any) -> str:
    """The code with which a message is refused because of this one field."""
    with pytest.raises(fields.FieldError) as caught:
        dataclasses.replace(example_of(cls), **{name: value})
    assert str(caught.value).startswith(f"{cls.__name__}.{name} ")
    assert "\n" not in str(caught.value)
    return caught.value.code


@pytest.mark.parametrize(("cls", "name", "rule"), every_field("int"))
def test_ints_keep_their_range_and_type(cls: type[Message], name: str, rule: fields.Rule) -> None:
    low, high = int(rule.low), int(rule.high)
    for value in (low, high):
        assert getattr(dataclasses.replace(example_of(cls), **{name: value}), name) == value
    assert refused(cls, name, low - 1) == "range"
    assert refused(cls, name, high + 1) == "range"
    for value in (True, False, None, 1.0, "1", b"1", [1], math.nan, np.int64(1)):
        assert refused(cls, name, value) == "malformed"


@pytest.mark.parametrize(("cls", "name", "rule"), every_field("float"))
def test_floats_are_finite_and_in_range(cls: type[Message], name: str, rule: fields.Rule) -> None:
    for value in (float(rule.low), float(rule.high)):
        assert getattr(dataclasses.replace(example_of(cls), **{name: value}), name) == value
    assert refused(cls, name, math.nextafter(rule.low, -math.inf)) == "range"
    assert refused(cls, name, math.nextafter(rule.high, math.inf)) == "range"
    for value in (math.nan, math.inf, -math.inf, 1, True, None, "1.0", np.float64(1)):
        assert refused(cls, name, value) == "malformed"


@pytest.mark.parametrize(("cls", "name", "rule"), every_field("str"))
def test_texts_are_strings_of_a_choice_or_a_length(cls: type[Message], name: str, rule: fields.Rule) -> None:
    for choice in rule.choices or ("", "x" * int(rule.high), "\N{HELICOPTER}"):
        assert getattr(dataclasses.replace(example_of(cls), **{name: choice}), name) == choice
    for value in ("x" * (int(rule.high) + 1), None, 1, b"uav", ["uav"], True):
        assert refused(cls, name, value) == "malformed"
    if rule.choices:
        assert refused(cls, name, "spy") == "malformed"
        assert refused(cls, name, rule.choices[0].upper()) == "malformed"


@pytest.mark.parametrize(("cls", "name", "rule"), every_field("str"))
def test_texts_that_cannot_be_encoded_are_refused(cls: type[Message], name: str, rule: fields.Rule) -> None:
    """Half a surrogate pair, as it comes from a file name that is not UTF-8: a message that exists can be sent."""
    assert refused(cls, name, "\udc80") == "malformed"


@pytest.mark.parametrize(("cls", "name", "rule"), every_field("bytes"))
def test_blobs_are_bytes_of_a_length(cls: type[Message], name: str, rule: fields.Rule) -> None:
    assert refused(cls, name, bytes(int(rule.high) + 1)) == "malformed"
    for value in (None, "onnx", 7, [1], bytearray(b"x"), memoryview(b"x")):
        assert refused(cls, name, value) == "malformed"


@pytest.mark.parametrize(("cls", "name", "rule"), every_field("array", "tensor"))
def test_arrays_have_their_type_dimensions_and_finite_entries(cls: type[Message], name: str, rule: fields.Rule) -> None:
    good = getattr(example_of(cls), name)
    other = "<f8" if rule.dtype == "<f4" else "<i4"
    for value in (None, 7, good.tolist(), good.tobytes(), good.astype(other), good[None], np.array(1, rule.dtype)):
        assert refused(cls, name, value) == "malformed"
    if "f" in rule.dtype:
        for number in (math.nan, math.inf, -math.inf):
            broken = np.ones((1,) * rule.ndim, rule.dtype)
            broken.ravel()[0] = number
            assert refused(cls, name, broken) == "range"


@pytest.mark.parametrize(("cls", "name", "rule"), every_field("array"))
def test_arrays_keep_their_longest_length(cls: type[Message], name: str, rule: fields.Rule) -> None:
    longest = np.zeros(int(rule.high), rule.dtype)
    assert getattr(dataclasses.replace(example_of(cls), **{name: longest}), name).size == rule.high
    assert refused(cls, name, np.zeros(int(rule.high) + 1, rule.dtype)) == "range"


@pytest.mark.parametrize("cls", [c for c in MESSAGES if any(r.kind == "array" for r in fields.rules(c).values())])
def test_the_longest_message_of_a_kind_can_be_decoded(cls: type[Message], same: Same) -> None:
    """What may be made may be sent: all arrays at their longest still fit into the header."""
    rules = fields.rules(cls)
    full = {name: np.ones(int(r.high), r.dtype) for name, r in rules.items() if r.kind == "array"}
    message = dataclasses.replace(example_of(cls), **full)
    assert same(decode(encode(message)), message)


@pytest.mark.parametrize(("cls", "name", "rule"), every_field("bytes", "tensor"))
def test_the_longest_frame_of_a_field_fits_the_sockets(cls: type[Message], name: str, rule: fields.Rule) -> None:
    """A larger one is dropped on arrival, and the client that it was for never hears of the TMC again."""
    size = np.dtype(rule.dtype).itemsize if rule.kind == "tensor" else 1
    assert rule.high * size <= FRAME_LIMIT_BYTES


def test_codes_of_field_errors_are_codes_of_the_error_reply() -> None:
    for code in ("malformed", "range"):
        assert m.Error(code, "x").code == code
