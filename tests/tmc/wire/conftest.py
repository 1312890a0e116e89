"""What the tests of the wire share: any valid message, by hypothesis, and equality of messages that hold arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from tmc.wire import fields
from tmc.wire.messages import MESSAGES, Message

SMALL = 5
"""Longest array, text or side of a tensor that is made up here."""


def value_of(rule: fields.Rule) -> st.SearchStrategy[Any]:
    """Values that keep a rule, its ends among them."""
    if rule.kind == "int":
        return st.integers(int(rule.low), int(rule.high))
    if rule.kind == "float":
        return st.floats(rule.low, rule.high)
    if rule.kind == "str":
        text = st.text(st.characters(codec="utf-8"), max_size=min(int(rule.high), 40))
        return st.sampled_from(rule.choices) if rule.choices else text
    if rule.kind == "bytes":
        return st.binary(max_size=SMALL)
    shape = array_shapes(min_dims=rule.ndim, max_dims=rule.ndim, min_side=0, max_side=SMALL)
    finite = {"allow_nan": False, "allow_infinity": False} if "f" in rule.dtype else {}
    return arrays(np.dtype(rule.dtype), shape, elements=finite)


@pytest.fixture(scope="session")
def valid() -> Callable[[type[Message]], st.SearchStrategy[Message]]:
    """Valid messages of a class."""
    return lambda cls: st.builds(cls, **{name: value_of(rule) for name, rule in fields.rules(cls).items()})


@pytest.fixture(scope="session")
def any_message(valid: Callable[[type[Message]], st.SearchStrategy[Message]]) -> st.SearchStrategy[Message]:
    """Valid messages of all classes."""
    return st.sampled_from(MESSAGES).flatmap(valid)


@pytest.fixture(scope="session")
def same() -> Callable[[Message, Message], bool]:
    """Whether two messages are equal in class, values, types and shapes."""

    def same_message(a: Any, b: Any) -> bool:
        if isinstance(a, np.ndarray):
            return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        return type(a) is type(b) and a == b

    def compare(a: Message, b: Message) -> bool:
        return type(a) is type(b) and all(same_message(getattr(a, n), getattr(b, n)) for n in fields.rules(type(a)))

    return compare
