"""Draw pictures without the user's settings of matplotlib, and report a failure in one sentence."""

from __future__ import annotations

import importlib
import logging
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from tmc.analysis.run_data import RunData
from tmc.analysis.summary import Summary
from tmc.kernel.roadmap import RoadMap

Made = TypeVar("Made")
Explain = Callable[[Exception], str]
ENVIRONMENT = {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
"""The environment for the import of matplotlib, which fails for some values that a notebook or a shell may set."""


class PictureError(Exception):
    """A picture cannot be drawn. The text is the reason, without the picture's name."""


def draw(
    run: RunData,
    summary: Summary,
    episode: int | None,
    baselines: Mapping[str, float],
    tell: Callable[[str], None],
    explain: Explain = str,
) -> list[Path]:
    """Draw the pictures of a run; return the paths of those that could be drawn.

    `tell` gets a sentence on each other one. `episode`, `baselines`: as in `tmc.analysis.report.figures.pictures`.
    `explain`: returns the fix for an import that failed, or an empty text.
    """
    made = []
    try:
        figures = _figures(explain)
        pictures = _safely(lambda: figures.pictures(run, summary, episode, baselines))
        for path, picture in pictures.items():
            try:
                made.append(_safely(picture))
            except PictureError as error:
                tell(f"the picture {path} could not be made: {error}")
    except PictureError as error:
        tell(f"no pictures: {error}")
    return made


def draw_map(road_map: RoadMap, path: Path, explain: Explain = str) -> None:
    """Draw a map; PictureError when that fails."""
    figures = _figures(explain)
    _safely(lambda: figures.map_picture(road_map, path))


def _safely(make: Callable[[], Made]) -> Made:
    with _quiet():
        try:
            return make()
        except Exception as error:  # library, fonts, disk or data: the run itself is complete
            raise PictureError(_reason(error)) from None


def _figures(explain: Explain) -> Any:
    """Import the module that draws. It takes half a second, and needs an extra."""
    with _quiet(), _own_environment():
        try:
            return importlib.import_module("tmc.analysis.report.figures")
        except Exception as error:
            raise PictureError(explain(error) or _reason(error)) from None


def _reason(error: Exception) -> str:
    """Return the reason on one line."""
    text = error.strerror if isinstance(error, OSError) else str(error)
    return " ".join((text or type(error).__name__).split())


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence matplotlib's notes on fonts, caches and settings."""
    log = logging.getLogger("matplotlib")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(before)


@contextmanager
def _own_environment() -> Iterator[None]:
    """Set ENVIRONMENT, and a working folder without settings: matplotlib first reads those of the current folder."""
    before = {name: os.environ.get(name) for name in ENVIRONMENT}
    here = None
    os.environ.update(ENVIRONMENT)
    try:
        with suppress(OSError):
            here = os.open(".", os.O_RDONLY)
            os.chdir("/")
        yield
    finally:
        if here is not None:
            os.fchdir(here)
            os.close(here)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
