"""The colours of viewers and pictures, safe for colour-blind readers. Needs no drawing library."""

from __future__ import annotations

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
"""Okabe and Ito's palette."""
UAV_COLOURS = (
    VERMILION, SKY, GREEN, PURPLE, BLACK, ORANGE, BLUE, YELLOW, "#882255", "#999933",
)  # fmt: skip
"""The colours of UAVs, by id modulo ten. Source: Okabe and Ito's palette, and two of Tol's."""


def colour_of(uav: int) -> str:
    """Return the colour of a UAV as `#RRGGBB`."""
    return UAV_COLOURS[uav % len(UAV_COLOURS)]


def shape_of(uav: int) -> int:
    """Return how many UAVs with a lower id have the same colour. Such UAVs differ by their shape."""
    return uav // len(UAV_COLOURS)
