"""The look of pictures, and figures without pyplot's global state."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tmc.kernel.text import printable
from tmc.record.disk import write_atomically

UAV_MARKERS = ("o", "s", "^", "D")
GREY, LIGHT, ROAD, BLOCKED = "#666666", "#F4F4F4", "#8C8C8C", "#3B3B3B"
UNCERTAINTY = "cividis"
DPI = 130
MAX_NAME_CHARS = 60
"""Length of a name in a title or a legend."""
OURS = {"text.parse_math": False}
"""Settings that differ from matplotlib's defaults: the name of a map may hold a `$`."""
BACKENDS = ("backend", "backend_fallback")
"""Settings of windows, which are not used."""


@contextmanager
def own_settings() -> Iterator[None]:
    """Draw with matplotlib's defaults and OURS, without the user's settings and without warnings.

    Also a decorator. The former settings are restored at the end.
    """
    defaults = {name: value for name, value in dict.items(matplotlib.rcParamsDefault) if name not in BACKENDS}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a glyph that no font has is drawn as a box
        with matplotlib.rc_context(defaults | OURS):
            yield


def name(text: str) -> str:
    """Return a user's name as it is drawn: short, on one line, and not `_x`, which legends leave out."""
    words = printable(text)
    words = words if len(words) <= MAX_NAME_CHARS else words[: MAX_NAME_CHARS - 3] + "..."
    return f" {words}" if words.startswith("_") else words


def figure(width: float, height: float) -> Figure:
    """Return a figure of this size, inches, with automatic layout; Agg draws it."""
    made = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(made)
    return made


def plain(axes: Any) -> None:
    """Remove the frame on the right and at the top; draw a light grid behind."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)


def save(made: Figure, path: Path) -> Path:
    """Write a PNG whole or not at all, and make its folder; return `path`. Raises OSError."""
    drawn = io.BytesIO()
    made.savefig(drawn, format="png")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, drawn.getvalue(), sync=False)
    return path
