"""The readers' logs are complete: every topic is there, and the killed mission was in flight."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.readers.conftest import KINDS
from tests.readers.missions import WRITERS
from tmc.record.channels import CHANNELS, REPLAY_CHANNELS, Channel
from tmc.record.reader import Log, info


def missing(table: tuple[Channel, ...], files: list[Path]) -> list[str]:
    topics = {topic for file in files for topic in info(file).topics}
    return [row.topic for row in table if not any(map(row.pattern.fullmatch, topics))]


def test_every_topic_is_in_a_finished_log(missions: Path) -> None:
    files = [file for name in ("trained", "flown", "losing") for file in sorted((missions / name).glob("*.mcap"))]
    assert all(Log(file).finished for file in files) and len(files) == 11
    assert missing(CHANNELS, files) == []
    assert missing(REPLAY_CHANNELS, [missions / "replay" / "flown.mcap"]) == []


def test_every_finished_file_is_of_a_kind(missions: Path) -> None:
    of_a_kind = [path for patterns in KINDS.values() for pattern in patterns for path in missions.glob(pattern)]
    assert sorted(of_a_kind) == sorted(missions.glob("*/*.mcap"))
    assert all(Log(path).finished for path in of_a_kind)


@pytest.mark.parametrize("left, names", [("killed", WRITERS), ("cut", ("tmc",))])
def test_logs_without_an_end_are_recovered(missions: Path, left: str, names: tuple[str, ...]) -> None:
    for name in names:
        before = info(missions / left / f"{name}.mcap.active")
        assert not before.finished and before.topics
        for way in ("resumed", "recovered"):
            after = info(missions / f"{way}-{left}" / f"{name}.mcap")
            assert after.finished and after.topics == before.topics
