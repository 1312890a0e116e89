"""docs/glossary.md names what exists: every class, module, setting, topic, message and command in it is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from deploy.cli import parser_for
from tests.contract.test_paper_map import names
from tests.docs.pages import subcommands
from tmc.kernel.config import SETTINGS
from tmc.record.channels import CHANNELS, REPLAY_CHANNELS
from tmc.wire.messages import MESSAGES

ROOT = Path(__file__).parents[2]
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text("utf-8")
ROWS = [
    tuple(cell.strip() for cell in line.strip("|").split(" | "))
    for line in GLOSSARY.splitlines()
    if line.startswith("| ") and not line.startswith(("| ---", "| term "))
]
TOPICS = {channel.topic for channel in (*CHANNELS, *REPLAY_CHANNELS)}
WORDS = (
    "incarnation", "flight record", "exchange", "exchange tick", "final tick", "station", "pilot", "airspace",
    "reorder buffer", "sample queue", "rate limiter", "samples due", "error buffer", "commit", "durable", "episode log",
    "invariant", "observation hash", "ack log", "fault schedule", "replay", "belief", "look-ahead", "track table",
    "beacon", "policy card", "policy spec", "run folder", "compact", "tau", "alpha", "T_u", "theta-", "roster",
    "commit gate", "outbox", "record builder", "target-value cache", "reference learner", "checker", "proxy",
)  # fmt: skip
"""What a reader of the code meets first: each must have its line."""


def exists(name: str) -> bool:
    """Whether a name of the last column is there, whatever kind of thing it is."""
    if name.startswith("overfly "):
        return tuple(name.split()[1:]) in COMMANDS
    if name.startswith("/"):
        return name in TOPICS
    if "/" in name:
        path, _, inside = name.partition(":")
        return (ROOT / path).is_file() and (not inside or inside in names(path))
    return name in SETTINGS or name in {message.__name__ for message in MESSAGES}


COMMANDS = subcommands(parser_for)


def test_every_row_has_a_term_a_meaning_and_a_place() -> None:
    assert len(ROWS) > 80
    assert [row for row in ROWS if len(row) != 3 or not all(row)] == []


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_what_a_row_names_exists(row: tuple[str, ...]) -> None:
    places = re.findall(r"`([^`]+)`", row[2])
    assert places
    assert [place for place in places if not exists(place)] == []


def test_a_meaning_is_one_line() -> None:
    assert [row[0] for row in ROWS if len(row[1]) > 120 or row[1].endswith(".")] == []


def test_no_term_stands_twice_and_the_words_of_the_code_are_there() -> None:
    terms = [row[0] for row in ROWS]
    assert len(terms) == len(set(terms))
    assert [word for word in WORDS if word not in terms] == []
