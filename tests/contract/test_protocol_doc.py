"""docs/reference/protocol.md agrees with tmc/wire/messages.py: each message, field, type, range, code and limit."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tmc.center.station import Station
from tmc.kernel.config import build
from tmc.kernel.roadmap import parse_raster
from tmc.kernel.world import World
from tmc.wire import codec, fields, sockets
from tmc.wire import messages as m

DOCUMENT = (Path(__file__).parents[2] / "docs" / "reference" / "protocol.md").read_text("utf-8")
NAMES = [cls.__name__ for cls in m.MESSAGES]
POWERS = {2**62: "2^62", 2**63 - 1: "2^63 - 1", 2**31 - 1: "2^31 - 1"}
UNITS = {"str": "characters", "bytes": "bytes", "array": "entries", "tensor": "entries"}


def section(title: str, level: int = 2) -> str:
    """The text under a heading, up to the next heading of its level or above."""
    found = re.search(rf"^{'#' * level} {title}\n(.*?)(?=^#{{1,{level}}} |\Z)", DOCUMENT, re.MULTILINE | re.DOTALL)
    assert found, f"docs/reference/protocol.md has no section '{title}'"
    return found[1]


def rows(text: str) -> list[list[str]]:
    """The cells of the first table in a text, without its head."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def named(cell: str) -> list[str]:
    """All names in backticks."""
    return re.findall(r"`([^`]+)`", cell)


def kind(rule: fields.Rule) -> str:
    if rule.kind == "array":
        return f"`{rule.dtype}` array"
    if rule.kind == "tensor":
        return f"`{rule.dtype}` tensor, {rule.ndim} {'axis' if rule.ndim == 1 else 'axes'}"
    return rule.kind


def span(rule: fields.Rule) -> str:
    if rule.choices:
        return ", ".join(f"`{name}`" for name in rule.choices)
    if rule.kind == "int":
        return " to ".join(POWERS.get(int(n), f"{n:,}") for n in (rule.low, rule.high))
    if rule.kind == "float":
        return f"{rule.low:g} to {rule.high:g}"
    return f"at most {int(rule.high):,} {UNITS[rule.kind]}"


def test_the_version() -> None:
    assert f"This is version {m.PROTOCOL} of the protocol." in DOCUMENT


def test_every_message_has_a_section_and_nothing_else_has() -> None:
    assert re.findall(r"^### (.+)$", section("Messages"), re.MULTILINE) == NAMES


@pytest.mark.parametrize("cls", m.MESSAGES, ids=NAMES)
def test_fields_types_and_ranges(cls: type[m.Message]) -> None:
    written = [row[:3] for row in rows(section(cls.__name__, 3))]
    assert written == [[f"`{name}`", kind(rule), span(rule)] for name, rule in fields.rules(cls).items()]


def test_every_message_has_a_sender_and_a_receiver() -> None:
    table = rows(section("Messages by sender"))
    assert [named(row[0])[0] for row in table] == NAMES
    assert all(row[1] and row[2] for row in table)


def test_every_answer_is_a_message() -> None:
    assert {name for row in rows(section("Messages by sender")) for name in named(row[3])} <= {*NAMES, "ask"}


def sample(cls: type[m.Message]) -> m.Message:
    """A message of the smallest values that its rules allow."""

    def least(rule: fields.Rule) -> object:
        if rule.kind in ("array", "tensor"):
            return np.zeros((0,) * rule.ndim, rule.dtype)
        plain: dict[str, object] = {"int": int(rule.low), "float": float(rule.low), "bytes": b""}
        return plain.get(rule.kind, (*rule.choices, "")[0])

    return cls(**{name: least(rule) for name, rule in fields.rules(cls).items()})


@pytest.mark.parametrize("cls", m.MESSAGES, ids=NAMES)
def test_the_tmc_takes_what_the_document_sends_to_it(cls: type[m.Message]) -> None:
    receiver = {named(row[0])[0]: row[2] for row in rows(section("Messages by sender"))}
    station = Station(World(build({"team.size": 1}), parse_raster("###\n#.#\n###")), "run", learning=True)
    station.handle("observer-test", sample(cls), 0.0)
    errors = [message for _, message in station.out.take().sends if isinstance(message, m.Error)]
    foreign = any(error.code == "state" and "not a message for the TMC" in error.text for error in errors)
    assert foreign is ("TMC" not in receiver[cls.__name__])


def test_the_codes_of_errors() -> None:
    assert [named(row[0])[0] for row in rows(section("Error codes"))] == list(fields.rules(m.Error)["code"].choices)


def test_the_limits() -> None:
    limits = {row[0]: row[1] for row in rows(section("Frames"))}
    assert limits == {
        "first frame": f"{codec.HEADER_LIMIT_BYTES:,} bytes",
        "any frame": f"{sockets.FRAME_LIMIT_BYTES:,} bytes",
        "frames per message": f"{sockets.MAX_FRAMES}",
    }


def test_the_example_endpoints() -> None:
    sync, feed = (row[1] for row in rows(section("Sockets and endpoints")))
    tcp, ipc = named(sync)
    assert sockets.learner_endpoint(tcp) == named(feed)[0]
    assert sockets.learner_endpoint(ipc) == ipc + named(feed)[1]


@pytest.mark.parametrize("name", ["uav-000", "uav-12345", "learner", "observer-a-1"])
def test_names_of_clients(name: str) -> None:
    assert sockets.sender_name(name.encode()) == name
    assert sockets.sender_name(f"{name}!".encode()) == f"{name}!".encode().hex()
