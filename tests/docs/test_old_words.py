"""Words that were given up are gone, from code, documents and tests; docs/glossary.md has what took their place.

Each pattern is written so that the plain English word, where there is one, still may be used.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("actors", "deploy", "docs", "learner", "tests", "tmc")
KINDS = {".py", ".pyi", ".md", ".toml", ".proto", ".js", ".mjs", ".css", ".cff"}
COUNTED = (
    r"(?:updates|ticks|steps|bytes|records|minibatches|samples|messages|visits|transitions|inserts|moves|cells"
    r"|(?:one|a) (?:minibatch|update|sample))"
)
PER = (
    r"(?:second|tick|UAV|step|minibatch|transition|road cell|cell|update|mission|move|episode|record|process|run|core)"
)
THING = r"(?:[Ll]ine|[Ff]ile|[Rr]ow|[Vv]alue|[Ee]ntry|[Ff]actor|[Ff]rame|[Ss]um|[Cc]ounter|[Nn]etwork|uint16|flag)"

PATTERNS: dict[str, tuple[str, str]] = {
    "life, lives": (r"\b(?:[Ll]ife|[Ll]ives)\b(?! in\b)", "incarnation"),
    "past": (r"\.past\b|\bpast\s*[:=]", "former"),
    "Early": (r"\bclass Early\b|\bEarly\(", "ReorderBuffer"),
    "Feed": (r"\bFeed\b|\bFEED\b|\bfeed endpoint|[`\"]\.feed\b|\bself\.feed\b", "SampleQueue, learner endpoint"),
    "Entry": (r"\bclass Entry\b|\bEntry\(", "JournalEntry, LogMessage"),
    "Limiter": (r"\bLimiter\b", "RateLimiter"),
    "owed, owes": (r"\bow(?:ed|es)\b", "samples due"),
    "slack": (r"\bself\.slack\b|\bslack: int\b|\bslack \* ratio\b", "error buffer"),
    "Flight": (r"\bclass Flight\b|\bFlight\(|\bimport Flight\b", "EpisodeState"),
    "settle": (r"\bsettle[ds]?\b", "finalise"),
    "truth clock": (r"\b[Tt]ruth clock\b", "final tick"),
    "exchange clock": (r"\b[Ee]xchange clock\b", "exchange tick"),
    "judge, verdict": (r"\bjudge[ds]?\b|\b_judged?\b|\b[Vv]erdict\b", "checker, initial priorities, TD errors"),
    "Found, Known": (r"\bclass (?:Found|Known)\b", "InvariantResult; TargetValueCache, ChannelTable"),
    "Intake": (r"\b[Ii]ntake\b|\blaid_out\b", "batching"),
    "bare loop": (r"\b[Bb]are (?:compute )?loop\b|\bbare\.py\b", "reference learner, textbook loop"),
    "Sight, Decider, Valued": (r"\bSight\b|\bDecider\b|\bclass Valued\b", "LocalState, Controller, QController"),
    "Leg": (r"\b[Ll]egs?\b", "RecordBuilder, record"),
    "spool": (r"\bspool\b", "unacknowledged"),
    "witness": (r"[Ww]itness|[Tt]estif|[Tt]estimon", "ObservationHasher"),
    "oath": (r"\b[Oo]aths?\b|\b[Ss]w(?:ear|ore)\b", "ack log"),
    "blow": (r"\b[Bb]lows?\b|\b\w+_blows?\b", "fault"),
    "storm": (r"\b[Ss]torms?\b|\bstorm_", "fault schedule"),
    "calm": (r"\b[Cc]alm\b", "finish"),
    "Hushed": (r"\b[Hh]ushed\b", "silent progress"),
    "Exactness, Wire": (r"\bclass (?:Exactness|Wire)\b", "DeliveryReport, CuttableProxy"),
    "reckon": (r"\b[Rr]eckon", "recompute, compute"),
    "evidence, strange": (r"\bevidence\b|\bstrange\b", "episode log, anomalies"),
    "Flown": (r"\bclass Flown\b", "RunData"),
    "binds, _secure, _may_change": (r"\bdef binds\b|:binds\b|\bbinds\(|\b_secure\b|\b_may_change\b", "CommitGate"),
    "constants without a unit": (
        r"\b(?:REST|BURST|PAUSE|FAREWELL|REUNION|LEAD|NAP|SILENCE|INFANCY|OVERDUE|FEW|SOME|MOST|HUGE|NOTHING|GONE|STINT)\b",
        "a name with its quantity and unit",
    ),
    "Who, WHO": (r"\bclass Who\b|\bWHO\b", "policy spec"),
    "seal": (r"\b[Ss]eal(?:s|ed|ing)?\b", "compact"),
    "sound": (r"\b[Uu]n?sound\b|\bSOUND\b|\bSound\b|\bsound (?:log|file|journal|message|chunk)", "intact, damaged"),
    "old settings": (
        r"\breplay\.(?:priority|correction)\b|\bcomms\.patience\b|\bteam\.pilot\b|\btraining\.push_every\b"
        r"|\bdqn\.batch\b|[\"'`]journal\.(?:commit|flush)[\"'`=]",
        "the names in docs/reference/settings.md",
    ),
    "a UAV a tick": (r"\ba UAV a (?:tick|step)\b", "per UAV per tick"),
    "updates a second": (rf"(?<!how many )\b{COUNTED} an? {PER}\b", "per"),
    "one a tick": (r"\bone an? (?:tick|UAV|move|step|cell|record|row|exchange|episode|line|sighting)\b", "one per ..."),
    "0.5 a cell": (r"(?:[Uu]ncertainty|\d|\}) a (?:road )?cell\b", "per road cell"),
    "a line a row": (rf"\b{THING} an? (?:{PER}|row|figure|topic|seed|invariant|monitored cell)\b", "one per"),
    "mend": (r"\bmend(?:s|ed)?\b", "fix"),
    "anew": (r"\banew\b", "again"),
    "for good": (r"\bfor good\b", "durably"),
    "gone on with": (r"\bgone on with\b", "resumed"),
    "held against": (r"\b(?:held|holds?) (?:\w+ )?against\b", "compared with"),
    "told of": (r"\btold of\b", "notified of"),
    "said again": (r"\bsa(?:id|ys?|ying) (?:it |them |the others )?again\b", "resent"),
    "is no X": (
        r"(?<![Tt]here )\b(?:is|are|be) no (?!(?:longer|better|worse|more|less|need|other|faster|slower)\b)[a-z]",
        "is not an X",
    ),
    "alike": (r"\balike\b", "the same"),
    "whoever, nobody": (r"\b(?:[Ww]hoever|[Nn]obody|[Ee]verybody|[Aa]nybody|[Ss]omebody|[Ee]veryone)\b", "the process"),
    "process who": (
        r"\b(?:those|UAVs?|peers?|process(?:es)?|learner|TMC|clients?|supervisor|it) who\b", "that, which",
    ),
}  # fmt: skip
"""What was given up: the pattern that finds it, and what to say instead."""

ONCE = ("Entry", "EpisodeState", "Journal", "Known", "Lost", "Observer", "Record", "Replay", "Team", "Truth", "World")
"""Names that meant two things: one class at most may have each."""


@cache
def texts() -> dict[str, str]:
    """All sources, documents and tests but this one, by path."""
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in KINDS]
    paths = [path for path in paths if "node_modules" not in path.parts and path != Path(__file__)]
    paths += [*ROOT.glob("*.md"), ROOT / "Makefile", ROOT / "pyproject.toml"]
    return {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in sorted(paths)}


@pytest.mark.parametrize("word", PATTERNS)
def test_an_old_word_is_gone(word: str) -> None:
    pattern, instead = re.compile(PATTERNS[word][0]), PATTERNS[word][1]
    found = [
        f"{path}:{text.count(chr(10), 0, match.start()) + 1}: {match[0]!r}"
        for path, text in texts().items()
        for match in pattern.finditer(text)
    ]
    assert found == [], f"say {instead!r} instead"


def test_a_name_that_meant_two_things_means_one() -> None:
    classes = Counter(
        node.name
        for path, text in texts().items()
        if path.endswith(".py") and not path.startswith(("tests/", "docs/"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ClassDef)
    )
    assert {name: classes[name] for name in ONCE if classes[name] > 1} == {}
