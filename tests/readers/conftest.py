"""Fixtures: the logs that every reader gets, and their contents by Overfly's own reader."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.readers.missions import make
from tmc.record.reader import Log, LogMessage


@dataclass
class Topic:
    """A topic of one log by Overfly's own reader: its schema, and its messages in file order."""

    schema: str
    entries: list[LogMessage] = field(default_factory=list)

    @property
    def times(self) -> list[int]:
        return [entry.log_time for entry in self.entries]

    @property
    def messages(self) -> list[Any]:
        return [entry.message for entry in self.entries]


@pytest.fixture(scope="session")
def missions(once: Callable[[str, Callable[[Path], object]], Path], trained: Callable[[int], Path]) -> Path:
    """The folder with all missions: flown once, by the first worker that needs them."""
    return once("readers", lambda folder: make(folder, trained(1)))


LIVE = ("trained", "flown", "losing", "lockstep")
"""Runs that ended in order."""
KINDS = {
    "tmc": [f"{name}/tmc.mcap" for name in LIVE],
    "learner": ["trained/learner.mcap"],
    "uav": [f"{name}/uav-*.mcap" for name in LIVE],
    "compacted": ["compacted/*.mcap"],
    "merged": ["merged/*.mcap"],
    "replay": ["replay/*.mcap"],
    "resumed": ["resumed-*/*.mcap"],
    "recovered": ["recovered-*/*.mcap"],
}
"""Each kind of file that Overfly writes, and where the missions have left it."""


@pytest.fixture(params=KINDS)
def logs(request: pytest.FixtureRequest, missions: Path) -> list[Path]:
    """Every finished file of a kind: each reader gets each kind."""
    paths = [path for pattern in KINDS[request.param] for path in sorted(missions.glob(pattern))]
    assert paths
    return paths


@pytest.fixture
def killed(missions: Path, tmp_path: Path) -> list[Path]:
    """The logs as a kill leaves them: whole chunks, or torn; copied to names that end in `.mcap`."""
    left = sorted(path for name in ("killed", "cut") for path in (missions / name).glob("*.active"))
    assert left
    return [Path(shutil.copy(path, tmp_path / f"{path.parent.name}-{path.stem}")) for path in left]


@pytest.fixture
def ours() -> Callable[[Path], dict[str, Topic]]:
    """Return {topic: what Overfly's own reader finds of it}."""

    def read(path: Path) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        schemas = {raw.topic: raw.schema for raw in Log(path).raw()}
        for entry in Log(path).entries():
            topics.setdefault(entry.topic, Topic(schemas[entry.topic])).entries.append(entry)
        return topics

    return read
