"""Write the reference pages that follow from the code: `python docs/generate.py`; with `--check`, compare them.

`reference/command.md` comes from the parsers of the command, `reference/settings.md` from the table of settings and the
presets, and `reference/frames.md` from the messages and the codec.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))  # the packages of this checkout, whatever else is installed

from deploy import settings  # noqa: E402
from deploy.cli import COMMANDS, parser_for  # noqa: E402
from tmc.kernel.config import SETTINGS, Setting, build, flat  # noqa: E402
from tmc.wire import codec, fields  # noqa: E402
from tmc.wire import messages as m  # noqa: E402

HEAD = "<!-- Written by docs/generate.py: change the code, then run it again. -->\n\n"
GROUPS = {
    "": "Scenario",
    "world": "World",
    "team": "Team",
    "comms": "Communication",
    "reward": "Reward",
    "exploration": "Exploration",
    "observation": "Observation",
    "network": "Network",
    "dqn": "DQN",
    "replay": "Replay",
    "training": "Training",
    "journal": "Journal",
    "trial": "Trials, which only overfly verify sets",
}
"""Titles of the groups of settings; a group that is not listed has its own name."""


def prose(text: str, indent: str = "") -> str:
    """A paragraph in lines of the width that all documents have."""
    return textwrap.fill(text, 120, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False) + "\n"


# The command.


def subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands below a command, by name."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def cell(text: str) -> str:
    """A text as a table takes it."""
    return text.replace("|", "\\|").replace("<", "\\<")


def code(text: str) -> str:
    """A text as a table takes it between backquotes."""
    return text.replace("|", "\\|")


def arguments(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """(how it is written, what it is) of each argument of a command, but for --help and what is only refused."""
    formatter = parser._get_formatter()
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction | argparse._SubParsersAction) or action.help is argparse.SUPPRESS:
            continue
        name = formatter._metavar_formatter(action, action.dest)(1)[0]
        if action.option_strings:
            written = action.option_strings[-1] if action.nargs == 0 else f"{action.option_strings[-1]} {name}"
        else:
            written = {"?": f"[{name}]", "+": f"{name}..."}.get(str(action.nargs), name)
        yield written, formatter._expand_help(action) if action.help else ""


def command_section(parser: argparse.ArgumentParser, name: str, depth: int) -> Iterator[str]:
    """The sections of a command and of those below it."""
    below = subparsers(parser)
    rows = list(arguments(parser))
    positional = " ".join(written for written, _ in rows if not written.startswith("-"))
    usage = " ".join(filter(None, [f"overfly {name}", "..." if below else positional]))
    options = " [OPTIONS]" if any(written.startswith("-") for written, _ in rows) else ""
    yield f"{'#' * depth} overfly {name}\n"
    yield prose(sentence(parser.description or ""))
    yield f"```text\n{usage}{options}\n```\n"
    if rows:
        yield "| argument | what |\n| --- | --- |"
        yield "\n".join(f"| `{code(written)}` | {cell(about)} |" for written, about in rows) + "\n"
    for word, sub in below.items():
        yield from command_section(sub, f"{name} {word}", depth + 1)


def sentence(text: str) -> str:
    """A line of help as a sentence."""
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def command_page() -> str:
    """`reference/command.md`."""
    parts = [
        "# The command\n",
        prose(
            "`overfly COMMAND --help` prints what stands here, and `overfly --version` the version. The "
            "[guides](../guides/index.md) say what a command is for, and [exit codes](exit-codes.md) what it returns."
        ),
        "| command | what it does |\n| --- | --- |",
        "\n".join(f"| [`{c.name}`](#overfly-{c.name}) | {cell(c.about)} |" for c in COMMANDS) + "\n",
    ]
    for command in COMMANDS:
        parser = subparsers(parser_for(command.name))[command.name]
        parts += command_section(parser, command.name, 2)
    return HEAD + "\n".join(parts)


# The settings.


def allowed(setting: Setting) -> str:
    """The values that a setting may have, with their unit."""
    kinds = {str: "text", tuple: "list of int"}
    if get_origin(setting.type) is Literal:
        values = ", ".join(f"`{choice}`" for choice in get_args(setting.type))
    else:
        values = setting.allowed or kinds.get(get_origin(setting.type) or setting.type, "")
    return cell(" ".join(filter(None, [values, setting.unit])))


def value(shown: Any) -> str:
    """A value as `--set` takes it."""
    if isinstance(shown, bool):
        return f"`{str(shown).lower()}`"
    if isinstance(shown, tuple | list):
        return f"`{','.join(map(str, shown))}`"
    return f"`{shown}`"


def linked(source: str) -> str:
    """A source, with a decision record as a link."""
    return re.sub(r"docs/adr/(\d{4})", lambda found: f"[decision {found[1]}]({record(found[1])})", source)


def record(number: str) -> str:
    """The path of a decision record, as seen from the reference."""
    return f"../adr/{next(DOCS.glob(f'adr/{number}-*.md')).name}"


def settings_page() -> str:
    """`reference/settings.md`."""
    parts = [
        "# Settings\n",
        prose(
            "Every setting has a dotted name, a default, a range with its unit, and a source. `--set "
            "replay.capacity=50000` changes one, and a list is written with commas: `--set "
            "network.channels=16,32`. The defaults are the paper's; where it leaves a point open, the source says "
            "so. `overfly doctor --settings --preset NAME` prints them as a preset has them."
        ),
        "Some settings have an option of their own:\n",
        "| option | setting |\n| --- | --- |",
        "\n".join(f"| `{option} {code(metavar)}` | `{key}` |" for option, key, metavar in settings.OPTIONS) + "\n",
    ]
    groups: dict[str, list[Setting]] = {}
    for setting in SETTINGS.values():
        groups.setdefault(setting.key.rpartition(".")[0], []).append(setting)
    for group, members in groups.items():
        parts.append(f"## {GROUPS.get(group, group)}\n")
        if members[0].trial:
            parts.append("`overfly verify` sets these; an ordinary mission has none of them.\n")
        parts.append("| setting | default | values | what | source |\n| --- | --- | --- | --- | --- |")
        rows = (
            f"| `{s.key}` | {value(s.default)} | {allowed(s)} | {cell(s.about)} | {linked(s.source)} |" for s in members
        )
        parts.append("\n".join(rows) + "\n")
    parts += presets()
    return HEAD + "\n".join(parts)


def presets() -> Iterator[str]:
    """What each preset changes."""
    yield "## Presets\n"
    yield "A preset is a TOML file in `deploy/presets/`. It changes what stands in its column.\n"
    names = settings.preset_names()
    values = {name: flat(build(settings.read_preset(name)[0])) for name in names}
    defaults = flat(build({}))
    for name in names:
        yield prose(f"- `{name}`: {settings.read_preset(name)[1]}.", "  ").rstrip()
    yield ""
    yield f"| setting | default | {' | '.join(f'`{name}`' for name in names)} |"
    yield "| --- | --- |" + " --- |" * len(names)
    for key, default in defaults.items():
        if any(values[name][key] != default for name in names):
            changed = (value(values[name][key]) if values[name][key] != default else "" for name in names)
            yield f"| `{key}` | {value(default)} | {' | '.join(changed)} |"
    yield ""


# The frames.

U1, U2, F4, I8 = np.dtype("u1"), np.dtype("<u2"), np.dtype("<f4"), np.dtype("<i8")
FIRST, LATER = 81_985_529_216_486_895, 81_985_529_216_486_896
"""Two incarnations."""
SENT_NS = 1_767_225_600_000_000_000
"""A wall clock: the first second of 2026."""


def array(dtype: np.dtype[Any], *values: float) -> Any:
    """An array of one axis."""
    return np.array(values, dtype)


EXAMPLES: tuple[m.Message, ...] = (
    m.Hello(role="uav", uav=1, incarnation=FIRST, updates=0),
    m.Welcome(
        config='{"scenario": 2, "team.size": 2}',
        map="0d5a3c",
        run="demo",
        tracks="/dev/shm/overfly-1/tracks",
        policy=3,
        sequence=0,
    ),
    m.Begin(
        episode=1, tick=0, shipped=-1, sequence=0, version=0, policy=3, last_visit=array(U2, 0, 0, 0),
        track=array(U2, 354), lost=array(U2),
    ),
    m.Record(
        uav=1, incarnation=FIRST, sequence=1, episode=1, first=1, tick=3, version=1, policy=3,
        cells=array(U2, 355, 356, 386), actions=array(U1, 3, 3, 1), blocks=array(U1, 0, 0, 0),
        rewards=array(F4, 1.5, 1.25, 1.0), seen_tick=array(U2, 3), seen_cell=array(U2, 387), values=array(F4),
        sent=SENT_NS,
    ),
    m.Map(
        episode=1, tick=3, version=2, policy=3, sequence=1, acknowledged=1, last_visit=array(U2, 0, 2, 3),
        active=array(U2),
    ),
    m.Alive(uav=1, incarnation=FIRST, tick=2, peer=0, sequence=1),
    m.Lost(episode=1, uav=0, tick=3),
    m.PolicyRequest(version=4),
    m.Policy(version=4, model=b"ONNX"),
    m.SampleRequest(request=7, index=array(I8, 12, 40), errors=array(F4, 0.5, 0.25), incarnation=LATER),
    m.Minibatch(
        request=7, episodes=0, ticks=200, cells=array(U2, 355, 356), peers=np.array([[387], [900]], U2),
        u=np.array([[0.5, 0.25, 0.0], [0.5, 0.0, 0.125]], F4), action=array(U1, 3), reward=array(F4, 1.5),
        discount=array(F4, 0.5), allowed=np.array([[1, 1, 1, 1, 1, 1, 1, 1, 1]], U1), index=array(I8, 12),
        weight=array(F4, 1.0),
    ),
    m.PolicyPush(version=4, updates=400, loss=0.25, model=b"ONNX", sent=SENT_NS, incarnation=LATER),
    m.Ack(version=4),
    m.Beacon(uav=0, episode=1, tick=2, cells=array(U2, 387, 388), to=array(U2, 1), ask=-1),
    m.StatusRequest(),
    m.Status(
        phase="flying", episode=1, tick=3, ticks=3, updates=0, policy=3, loss=0.0, uncertainty=1.5,
        episode_uncertainty=0.0, blocked=0, rejected=0, waiting="uav-000",
    ),
    m.End(reason="the mission is over", acknowledged=2),
    m.Bye(role="uav", uav=1, reason="SIGTERM"),
    m.Error(code="state", text="the record is not the next one: say Hello", incarnation=FIRST),
)  # fmt: skip
"""One message of each type, as in a mission of two UAVs."""


def spaced(data: bytes) -> str:
    """Hex, in lines of 32 bytes."""
    text = data.hex(" ")
    return "\n".join(text[start : start + 96].strip() for start in range(0, len(text), 96))


def shown(message: m.Message, name: str, rule: fields.Rule) -> str:
    """A field of the first frame: JSON, or for an array its bytes in hex."""
    held = getattr(message, name)
    if rule.kind == "array":
        return f"h'{held.tobytes().hex()}'"
    return json.dumps(list(held.shape) if rule.kind == "tensor" else held)


def frame_section(message: m.Message) -> Iterator[str]:
    """The section of one message."""
    rules = fields.rules(type(message))
    frames = [bytes(memoryview(frame).cast("B")) for frame in codec.encode(message)]
    lines = [f'"type": "{type(message).__name__}"', f'"v": {m.PROTOCOL}']
    lines += [f'"{name}": {shown(message, name, rule)}' for name, rule in rules.items() if rule.kind != "bytes"]
    later = [name for name, rule in rules.items() if rule.kind in ("tensor", "bytes")]
    yield f"## {type(message).__name__}\n"
    yield "```text\n{" + ",\n ".join(lines) + "}\n```\n"
    for number, (frame, name) in enumerate(zip(frames, ["", *later], strict=True), 1):
        what = f", `{name}`" if name else ""
        yield f"Frame {number}{what}, {len(frame)} bytes:\n"
        yield f"```text\n{spaced(frame)}\n```\n"


def frames_page() -> str:
    """`reference/frames.md`."""
    parts = [
        "# Example frames\n",
        prose(
            "One message of each type, as it goes over the wire: first the msgpack map of the first frame in words, "
            "then the bytes of each frame in hex. `h'6301'` stands for bytes. Another implementation can be tested "
            "with them. What the fields mean is in [the protocol](protocol.md#messages)."
        ),
    ]
    for message in EXAMPLES:
        parts += frame_section(message)
    return HEAD + "\n".join(parts)


PAGES = {"command": command_page, "settings": settings_page, "frames": frames_page}


def stale() -> list[Path]:
    """The pages that are not what the code says now."""
    found = []
    for name, page in PAGES.items():
        path = DOCS / "reference" / f"{name}.md"
        if not path.exists() or path.read_text("utf-8") != page():
            found.append(path)
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Write the pages, or with `--check` only name those that are stale; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 when a page is stale")
    args = parser.parse_args(argv)
    for path in (found := stale()):
        if args.check:
            print(f"{path} is stale: run python docs/generate.py")
        else:
            path.write_text(PAGES[path.stem](), "utf-8")
            print(f"{path} written")
    return int(args.check and bool(found))


if __name__ == "__main__":
    sys.exit(main())
