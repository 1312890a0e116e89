"""How pictures look: colours that everybody can tell apart, and figures without pyplot's global state."""

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

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
"""Okabe and Ito's palette."""
UAV_COLOURS = (VERMILION, SKY, GREEN, PURPLE, BLACK, ORANGE, BLUE, YELLOW, "#882255", "#999933")
"""By UAV, two of Tol's added; over again after ten: the marker's shape then differs."""
UAV_MARKERS = ("o", "s", "^", "D")
GREY, LIGHT, ROAD, BLOCKED = "#666666", "#F4F4F4", "#8C8C8C", "#3B3B3B"
UNCERTAINTY = "cividis"
DPI = 130
LONGEST = 60
"""Characters of a name in a title or a legend."""
OURS = {"text.parse_math": False}
"""matplotlib's settings beside its defaults: a map may be called `$x$`, and that is its name."""
BACKENDS = ("backend", "backend_fallback")
"""Settings of windows, of which there are none."""


@contextmanager
def own_settings() -> Iterator[None]:
    """Draw by matplotlib's defaults and OURS, whatever a user's matplotlibrc or program has set, and warn of nothing.

    Also a decorator; what was set before is set again at the end.
    """
    defaults = {name: value for name, value in dict.items(matplotlib.rcParamsDefault) if name not in BACKENDS}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a glyph that no font has is drawn as a box
        with matplotlib.rc_context(defaults | OURS):
            yield


def name(text: str) -> str:
    """A user's name for something, as it is drawn: short, and on one line; `_x` would be left out of a legend."""
    words = printable(text)
    words = words if len(words) <= LONGEST else words[: LONGEST - 3] + "..."
    return f" {words}" if words.startswith("_") else words


def figure(width: float, height: float) -> Figure:
    """A figure of so many inches that lays itself out; Agg draws it when it is saved as PNG."""
    made = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(made)
    return made


def plain(axes: Any) -> None:
    """No frame on the right and at the top, a light grid behind."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)


def save(made: Figure, path: Path) -> Path:
    """Write a PNG, its folder too; returns `path`."""
    drawn = io.BytesIO()
    made.savefig(drawn, format="png")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(drawn.getvalue())
    return path
