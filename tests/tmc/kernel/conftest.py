"""What the kernel's tests share: small worlds with roads, obstacles and edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tmc.kernel.config import build
from tmc.kernel.roadmap import parse_raster
from tmc.kernel.world import World

SMALL = """\
.#..#..
###X###
.#..#..
.#####.
X#..#.X
"""
"""5 x 7 cells: 17 road, 3 blocked, 15 free; blocked cells inside and in two corners."""


@pytest.fixture(scope="session")
def world_of() -> Callable[..., World]:
    """A world on a text raster, with dotted settings replaced."""

    def make(settings: dict[str, Any] | None = None, raster: str = SMALL) -> World:
        return World(build({"training.ticks": 50, **(settings or {})}), parse_raster(raster))

    return make
