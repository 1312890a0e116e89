"""Colours that everybody can tell apart, for viewers as for pictures, and free of any drawing library."""

from __future__ import annotations

UAV_COLOURS = (
    "#D55E00", "#56B4E9", "#009E73", "#CC79A7", "#000000", "#E69F00", "#0072B2", "#F0E442", "#882255", "#999933",
)  # fmt: skip
"""By UAV: Okabe and Ito's palette and two of Tol's; over again after ten, then with another shape."""


def colour_of(uav: int) -> str:
    """The colour of a UAV as `#RRGGBB`."""
    return UAV_COLOURS[uav % len(UAV_COLOURS)]


def round_of(uav: int) -> int:
    """How often the colours have been used up before this UAV: another round has another shape."""
    return uav // len(UAV_COLOURS)
