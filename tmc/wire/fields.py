"""The rules of message fields: kind, range and size, beside each field, checked when a message is made."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

FRAME_LIMIT_BYTES = 64 * 1024 * 1024
"""Largest frame that a socket accepts (tmc.wire.sockets)."""
SMALL_ARRAY_ENTRIES = 64
"""Up to this size, plain Python checks an array faster than NumPy."""


class FieldError(ValueError):
    """A field violates its rule. `code` is the code of the error reply."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True)
class Rule:
    """What a field may hold. `kind`: int, float, str, bytes, array (1-D, in the header) or tensor (its own frame)."""

    kind: str
    low: float = 0.0
    high: float = 0.0
    choices: tuple[str, ...] = ()
    dtype: str = ""
    ndim: int = 1

    @cached_property
    def numpy(self) -> np.dtype[Any]:
        """The dtype of an array or a tensor."""
        return np.dtype(self.dtype)


def _field(rule: Rule, default: Any = dataclasses.MISSING, *, empty: bool = False) -> Any:
    if empty:
        return dataclasses.field(default_factory=lambda: np.zeros(0, rule.dtype), metadata={"rule": rule})
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata={"rule": rule})
    return dataclasses.field(default=default, metadata={"rule": rule})


def integer(low: int, high: int, default: Any = dataclasses.MISSING) -> Any:
    """Declare an int, not a bool, in low..high."""
    return _field(Rule("int", low, high), default)


def real(low: float, high: float) -> Any:
    """Declare a finite float in low..high."""
    return _field(Rule("float", low, high))


def choice(*names: str) -> Any:
    """Declare one of these strings."""
    return _field(Rule("str", 0, 64, choices=names))


def text(longest: int) -> Any:
    """Declare a string of at most `longest` characters."""
    return _field(Rule("str", 0, longest))


def blob(longest: int) -> Any:
    """Declare at most `longest` bytes, in their own frame."""
    return _field(Rule("bytes", 0, longest))


def array(dtype: str, longest: int, *, empty: bool = False) -> Any:
    """Declare an array of one axis, with at most `longest` entries, in the header as little-endian bytes.

    Floats must be finite. `empty`: the default is an empty array.
    """
    return _field(Rule("array", 0, longest, dtype=dtype), empty=empty)


def tensor(dtype: str, ndim: int, *, empty: bool = False) -> Any:
    """Declare a large array in its own frame, which neither side copies. `empty`: as in `array`; for one axis only."""
    return _field(Rule("tensor", 0, FRAME_LIMIT_BYTES // np.dtype(dtype).itemsize, dtype=dtype, ndim=ndim), empty=empty)


def rules(cls: type) -> dict[str, Rule]:
    """Return the rule of each field of a message class, in order."""
    cached: dict[str, Rule] | None = cls.__dict__.get("_rules")
    if cached is None:
        cached = {f.name: f.metadata["rule"] for f in dataclasses.fields(cls)}
        cls._rules = cached  # type: ignore[attr-defined]
    return cached


def check(message: Any) -> None:
    """Raise FieldError for the first field that violates its rule."""
    for name, rule in rules(type(message)).items():
        problem = _CHECKS[rule.kind](getattr(message, name), rule)
        if problem:
            code = "range" if problem.startswith("is out of") else "malformed"
            raise FieldError(code, f"{type(message).__name__}.{name} {problem}")


def _int(value: Any, rule: Rule) -> str:
    if type(value) is not int:
        return f"must be an int, not {type(value).__name__}"
    return "" if rule.low <= value <= rule.high else f"is out of range: {value} is not in {rule.low}..{rule.high}"


def _float(value: Any, rule: Rule) -> str:
    if type(value) is not float or not math.isfinite(value):
        return "must be a finite float"
    return "" if rule.low <= value <= rule.high else f"is out of range: {value} is not in {rule.low:g}..{rule.high:g}"


def _str(value: Any, rule: Rule) -> str:
    if type(value) is not str or len(value) > rule.high:
        return f"must be a string of at most {int(rule.high)} characters"
    try:
        value.encode()
    except UnicodeEncodeError:
        return "must be text that UTF-8 can carry"
    return "" if not rule.choices or value in rule.choices else f"must be one of {', '.join(rule.choices)}"


def _bytes(value: Any, rule: Rule) -> str:
    return "" if isinstance(value, bytes) and len(value) <= rule.high else f"must be at most {int(rule.high)} bytes"


def _array(value: Any, rule: Rule) -> str:
    if not isinstance(value, np.ndarray) or value.dtype != rule.numpy or value.ndim != rule.ndim:
        return f"must be an array of {rule.dtype} with {rule.ndim} dimension(s)"
    if value.size > rule.high:
        return f"is out of range: {value.size} entries, at most {int(rule.high)}"
    if rule.numpy.kind == "f" and not _all_finite(value):
        return "is out of range: it holds a value that is not finite"
    return ""


def _all_finite(value: Any) -> bool:
    """Return True when all values are finite. A flight record has about ten, which plain Python checks faster."""
    return (
        all(map(math.isfinite, value.ravel().tolist()))
        if value.size <= SMALL_ARRAY_ENTRIES
        else bool(np.isfinite(value).all())
    )


_CHECKS = {"int": _int, "float": _float, "str": _str, "bytes": _bytes, "array": _array, "tensor": _array}
