"""Every file, name, test and setting that the paper map names exists, and every file that the other pages name."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from tmc.kernel.config import SETTINGS

ROOT = Path(__file__).parents[2]
PAPER_MAP = (ROOT / "docs" / "explanation" / "paper-map.md").read_text("utf-8")
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in (*ROOT.glob("docs/**/*.md"), *ROOT.glob("*.md")))
LAWS = "Laws without a number (Sec. II-B to II-D)"
PATH = re.compile(r"`((?:actors|deploy|docs|learner|tests|tmc)/[\w./-]*)(?:(::|:)([\w.]+))?`")


@cache
def names(path: str) -> frozenset[str]:
    """All that a file defines: `name`, and `Class.name` for methods."""
    found = set()
    for node in ast.parse((ROOT / path).read_text("utf-8")).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {t.id for t in targets if isinstance(t, ast.Name)}
        elif isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
            inner = node.body if isinstance(node, ast.ClassDef) else []
            found |= {f"{node.name}.{m.name}" for m in inner if isinstance(m, ast.FunctionDef)}
    return frozenset(found)


def references(text: str) -> list[tuple[str, str, str]]:
    """(path, ":" or "::" or "", name) of everything in backticks that looks like a place in the project."""
    return [(m[1], m[2] or "", m[3] or "") for m in PATH.finditer(text)]


@pytest.mark.parametrize("page", PAGES)
def test_every_place_exists(page: str) -> None:
    missing = []
    for path, separator, name in references((ROOT / page).read_text("utf-8")):
        whole = f"{path}{separator}{name}"
        if not (ROOT / path).exists() or (name and name not in names(path)):
            missing.append(whole)
        elif separator == "::" and not (path.startswith("tests/") and name.startswith("test_")):
            missing.append(f"{whole} is not a test")
    assert not missing


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_somewhere(page: str) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / page).read_text("utf-8"))
    assert not [link for link in links if not (ROOT / page).parent.joinpath(link).exists()]


def test_every_setting_exists() -> None:
    groups = {key.partition(".")[0] for key in SETTINGS if "." in key}
    written = set(re.findall(rf"`((?:{'|'.join(groups)})\.(?:\w+|\*))", PAPER_MAP))
    assert written
    assert not {key for key in written if key not in SETTINGS and not key.endswith(".*")}


def column(title: str) -> list[str]:
    """The first column of the table under a heading."""
    section = PAPER_MAP.split(f"## {title}\n")[1].split("\n## ")[0]
    return [line.split("|")[1].strip() for line in section.splitlines() if line.startswith("|")][2:]


def test_no_equation_row_or_claim_is_left_out() -> None:
    assert column("Equations") == [f"({n})" for n in range(1, 14)]
    assert len(column("Table I")) == 10
    assert [claim.split()[0] for claim in column("Claims")] == [f"C{n}" for n in range(1, 12)]


def test_every_row_names_code_and_test() -> None:
    for title in ("Equations", LAWS, "Table I", "Algorithm 1", "What the paper leaves open"):
        section = PAPER_MAP.split(f"## {title}\n")[1].split("\n## ")[0]
        rows = [line for line in section.splitlines() if line.startswith("|")][2:]
        bare = [row for row in rows if not {":", "::"} <= {separator for _, separator, _ in references(row)}]
        assert not bare
