"""The pages that are written from the code are current, and the others keep their promises."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tmc.kernel.roadmap import parse_raster
from tmc.wire import codec, fields, process
from tmc.wire import messages as m

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
SOURCES = [path for folder in ("actors", "deploy", "learner", "tmc") for path in sorted((ROOT / folder).rglob("*.py"))]


def load() -> ModuleType:
    """docs/generate.py as a module."""
    spec = importlib.util.spec_from_file_location("docs_generate", DOCS / "generate.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


GENERATE = load()


def test_the_generated_pages_are_current() -> None:
    assert GENERATE.stale() == [], "run python docs/generate.py"


def test_every_message_has_an_example() -> None:
    assert [type(message) for message in GENERATE.EXAMPLES] == list(m.MESSAGES)


@pytest.mark.parametrize("example", GENERATE.EXAMPLES, ids=lambda e: type(e).__name__)
def test_the_frames_of_the_document_are_those_of_the_example(example: m.Message) -> None:
    page = (DOCS / "reference" / "frames.md").read_text("utf-8")
    section = page.split(f"\n## {type(example).__name__}\n")[1].split("\n## ")[0]
    blocks = re.findall(r"^Frame \d.*?, (\d+) bytes:\n\n```text\n(.*?)\n?```", section, re.MULTILINE | re.DOTALL)
    frames = [bytes.fromhex(block.replace("\n", " ")) for _, block in blocks]
    assert [len(frame) for frame in frames] == [int(size) for size, _ in blocks]
    decoded = codec.decode(frames)
    for name in fields.rules(type(example)):
        assert np.array_equal(getattr(decoded, name), getattr(example, name)), name


def test_documents_that_sources_name_exist() -> None:
    named = {(path, name) for path in SOURCES for name in re.findall(r"\bdocs/[\w./-]+\.md\b", path.read_text("utf-8"))}
    assert sorted(f"{path.relative_to(ROOT)}: {name}" for path, name in named if not (ROOT / name).exists()) == []


def test_the_readme_is_short_and_begins_with_the_commands() -> None:
    lines = (ROOT / "README.md").read_text("utf-8").splitlines()
    assert len(lines) <= 110
    first = "\n".join(lines[:30])
    assert "make demo" in first and "make test" in first and "](docs/images/paths.png)" in first


def sentences() -> str:
    """All strings of the sources, with a mark where an f-string has a value."""
    found = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts = (part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
                found.append("".join(map(str, parts)))
    return "\n".join(found)


def test_what_troubleshooting_quotes_is_said_by_the_command() -> None:
    """Upper-case words, `...` and single letters of a quotation stand for values."""
    said = sentences()
    page = (DOCS / "troubleshooting.md").read_text("utf-8")
    quotes = [
        quote for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE) for quote in re.findall(r"`([^`]+)`", row)
    ]
    assert len(quotes) > 40
    pieces = {
        piece.strip(" :,'") for quote in quotes for piece in re.split(r"\.\.\.|\b[A-Z]{1,8}\b|\b[a-z]\b|\(|\)", quote)
    }
    assert sorted(piece for piece in pieces if len(piece) > 7 and piece not in said) == []


def test_every_exit_code_is_in_the_document() -> None:
    page = (DOCS / "reference" / "exit-codes.md").read_text("utf-8")
    codes = {int(code) for code in re.findall(r"^\| (\d+) \|", page, re.MULTILINE)}
    assert {process.DONE, process.FAILED, process.USAGE, process.FENCED, process.STOPPED} <= codes
    assert {128 + number for number in process.ENDING} <= codes


def test_the_map_of_the_guide_is_a_map() -> None:
    page = (DOCS / "guides" / "your-own-map.md").read_text("utf-8")
    town = parse_raster(page.split("```text\n")[1].split("```")[0])
    assert (town.name, town.cell_m, int(town.road.sum()), int(town.blocked.sum())) == ("my town", 60.0, 10, 1)


def test_every_page_is_in_the_site() -> None:
    pages = {path.resolve() for path in DOCS.rglob("*.md")} - {(DOCS / "index.md").resolve()}
    listed = set()
    for page in DOCS.rglob("*.md"):
        for block in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
            for line in filter(None, (line for line in block.splitlines() if not line.startswith(":"))):
                listed |= {path.resolve() for path in page.parent.glob(f"{line}.md")}
    assert pages == listed


def test_the_citation_names_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    version = re.search(r'^version = "(.+)"$', project, re.MULTILINE)
    assert version is not None
    assert f"\nversion: {version[1]}\n" in citation
    assert "cff-version: 1.2.0" in citation and "arXiv:2107.04924" in citation
