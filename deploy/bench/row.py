"""A row of a bench's result, and the machine that it was measured on."""

from __future__ import annotations

import math
import os
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Row:
    """One figure. `ratio`: value / reference, or the median of such ratios taken in pairs; None without one.

    `what`: the reference, in words.
    """

    bench: str
    case: str
    value: float | None
    unit: str
    reference: float | None = None
    ratio: float | None = None
    what: str = ""


def finite(x: Any) -> Any:
    """Return None for a float that is not finite, since JSON cannot hold it; otherwise `x`."""
    return None if isinstance(x, float) and not math.isfinite(x) else x


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine() -> dict[str, Any]:
    """Return processor, cores, load and versions, which belong to every figure."""
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": core_count(),
        "load": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        **{name: _version(name) for name in ("overfly", "numpy", "torch", "pyzmq", "onnxruntime")},
    }


def _processor() -> str:
    """Return the name of the processor's model if Linux gives it, otherwise of its architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def text(rows: list[Row]) -> str:
    """Return the rows as a table of text."""
    lines = [f"{'case':<34} {'value':>12} {'unit':<22} {'reference':>12} {'ratio':>6}"]
    lines += [
        f"{r.case:<34} {_number(r.value):>12} {r.unit:<22} {_number(r.reference):>12} "
        f"{'' if finite(r.ratio) is None else f'{r.ratio:.2f}':>6} {r.what}".rstrip()
        for r in rows
    ]
    return "\n".join(lines)


def _number(x: float | None) -> str:
    if x is None or not math.isfinite(x):
        return "-"
    return f"{x:,.0f}" if abs(x) >= 1000 else f"{x:.4g}"
