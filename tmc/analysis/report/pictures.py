"""The way to the pictures: matplotlib without the user's settings for it, and failures that cost a sentence each."""

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
"""For the import of matplotlib, which fails for some of what a notebook or a shell may have set."""


class PictureError(Exception):
    """A picture cannot be drawn: the reason, without the picture's name."""


def draw(
    flown: RunData,
    summary: Summary,
    episode: int | None,
    baselines: Mapping[str, float],
    tell: Callable[[str], None],
    explain: Explain = str,
) -> list[Path]:
    """Make the pictures of a run; returns the paths of those that could be made.

    `tell` is given a sentence for each other one.

    `episode`, `baselines`: as in `tmc.analysis.report.figures.pictures`. `explain`: what to do where something
    cannot be imported; empty for what it does not know.
    """
    made = []
    try:
        figures = _figures(explain)
        pictures = _safely(lambda: figures.pictures(flown, summary, episode, baselines))
        for path, picture in pictures.items():
            try:
                made.append(_safely(picture))
            except PictureError as error:
                tell(f"the picture {path} could not be made: {error}")
    except PictureError as error:
        tell(f"no pictures: {error}")
    return made


def draw_map(road_map: RoadMap, path: Path, explain: Explain = str) -> None:
    """Make a picture of a map; PictureError when it cannot be."""
    figures = _figures(explain)
    _safely(lambda: figures.map_picture(road_map, path))


def _safely(make: Callable[[], Made]) -> Made:
    with _quiet():
        try:
            return make()
        except Exception as error:  # a library, fonts, a disk, odd data: whatever it is, the work was done
            raise PictureError(_reason(error)) from None


def _figures(explain: Explain) -> Any:
    """The module that draws; half a second, and an extra."""
    with _quiet(), _own_environment():
        try:
            return importlib.import_module("tmc.analysis.report.figures")
        except Exception as error:
            raise PictureError(explain(error) or _reason(error)) from None


def _reason(error: Exception) -> str:
    """On one line, which is not what every library has."""
    text = error.strerror if isinstance(error, OSError) else str(error)
    return " ".join((text or type(error).__name__).split())


@contextmanager
def _quiet() -> Iterator[None]:
    """Without matplotlib's notes on fonts, caches and other people's settings."""
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
    """ENVIRONMENT, in a folder without settings: matplotlib reads those of the current one first."""
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
