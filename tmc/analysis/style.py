"""How pictures look: colours that everybody can tell apart, and figures without pyplot's global state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tmc.record.errors import RecordError

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


def figure(width: float, height: float) -> Figure:
    """A figure of so many inches that lays itself out; Agg draws it when it is saved as PNG."""
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")


def plain(axes: Any) -> None:
    """No frame on the right and at the top, a light grid behind."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)


def save(made: Figure, path: Path) -> Path:
    """Write a PNG, its folder too; RecordError when that cannot be."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        made.savefig(path, format="png")
    except OSError as error:
        raise RecordError(f"{path} cannot be written ({error.strerror}): make its folder writable") from None
    return path
