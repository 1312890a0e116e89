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
    m.Hello(role="uav", uav=2, incarnation=12345),
    m.Hello(role="learner", uav=-1, incarnation=2**63 - 1, updates=7),
    m.Welcome(config='{"team.size": 3}', map="ab" * 32, run="run-1", tracks="/tmp/tracks", policy=4),
    m.Begin(
        episode=1,
        tick=1,
        shipped=-1,
        sequence=0,
        version=0,
        policy=1,
        last_visit=numbers("<u2", 0, 1),
        track=numbers("<u2", 17, 18),
        lost=EMPTY,
    ),
    m.Record(
        uav=2,
        incarnation=12345,
        sequence=3,
        episode=1,
        first=1,
        tick=2,
        version=5,
        policy=4,
        cells=numbers("<u2", 7, 8),
        actions=numbers("u1", 3, 8),
        blocks=numbers("u1", 0, 1),
        rewards=numbers("<f4", 1.5, -20),
        seen_tick=numbers("<u2", 2),
        seen_cell=numbers("<u2", 9),
    ),
    m.Record(
        uav=2,
        incarnation=12345,
        sequence=4,
        episode=1,
        first=3,
        tick=3,
        version=5,
        policy=4,
        cells=numbers("<u2", 7),
        actions=numbers("u1", 8),
        blocks=numbers("u1", 0),
        rewards=numbers("<f4", 1.5),
        seen_tick=EMPTY,
        seen_cell=EMPTY,
        values=numbers("<f4", 0.25, 2.5),
    ),
    m.Map(
        episode=1,
        tick=10,
        version=5,
        policy=4,
        sequence=3,
        acknowledged=2,
        last_visit=numbers("<u2", 0, 10, 3),
        active=EMPTY,
    ),
    m.Alive(uav=1, incarnation=12345, tick=40, peer=-1, sequence=7),
    m.Lost(episode=2, uav=1, tick=30),
    m.PolicyRequest(version=4),
    m.Policy(version=4, model=b"\x08\x01onnx\x00"),
    m.SampleRequest(request=9),
    m.SampleRequest(request=10, index=numbers("<i8", 3, 2**40), errors=numbers("<f4", 0.5, 7)),
    m.Minibatch(
        request=9,
        episodes=0,
        ticks=100,
        cells=numbers("<u2", 4, 5, 6, 7),
        peers=np.arange(8, dtype="<u2").reshape(4, 2),
        u=MAPS,
        action=numbers("u1", 1, 8),
        reward=numbers("<f4", 1, 2),
        discount=numbers("<f4", 0.9, 0.9),
        allowed=np.ones((2, 9), "u1"),
        index=numbers("<i8", 0, 2**40),
    ),
    m.Minibatch(
        request=9,
        episodes=0,
        ticks=100,
        cells=numbers("<u2", 4, 6),
        peers=np.zeros((2, 0), "<u2"),
        u=MAPS[:2],
        action=numbers("u1", 1),
        reward=numbers("<f4", 1),
        discount=numbers("<f4", 0.9),
        allowed=np.ones((1, 9), "u1"),
        index=numbers("<i8", 2**40),
        weight=numbers("<f4", 0.5),
    ),
    m.PolicyPush(version=5, updates=100, loss=0.25, model=b"onnx"),
    m.Ack(version=5),
    m.Beacon(uav=0, episode=1, tick=3, cells=numbers("<u2", 4, 5), to=numbers("<u2", 1, 2)),
    m.Beacon(uav=0, episode=1, tick=3, cells=EMPTY, to=EMPTY, ask=3),
    m.StatusRequest(),
    m.Status(
        phase="flying",
        episode=1,
        tick=10,
        ticks=30,
        updates=5,
        policy=2,
        loss=0.5,
        uncertainty=12.25,
        episode_uncertainty=13.0,
        blocked=1,
        rejected=0,
        waiting="uav-001",
    ),
    m.End(reason="the mission is over"),
    m.Bye(role="uav", uav=2, reason="SIGTERM"),
    m.Error(code="range", text="Record.tick is out of range"),
)


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
    rest = {"reward": none, "discount": none, "allowed": np.ones((0, 9), "u1"), "index": np.zeros(0, "<i8")}
    empty = m.Minibatch(
        request=9, episodes=0, ticks=100, cells=cells, peers=peers, u=MAPS[:0], action=numbers("u1"), **rest
    )
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
        assert m.Error(code=code, text="x").code == code
