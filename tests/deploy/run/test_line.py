"""The line of progress: cut to the terminal's current width, whole elsewhere; it never makes work fail."""

from __future__ import annotations

import errno
import fcntl
import io
import os
import pty
import struct
import termios
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TextIO

import pytest

from deploy.run import line
from deploy.run.line import Line, fit
from deploy.run.progress import Progress
from tmc.kernel.config import build
from tmc.wire.messages import Status

LONG = "episode 3/500 · tick 2,410/500,000 · " + "and more, " * 30
END = "<end>"
Open = Callable[[int], tuple[TextIO, int]]


@pytest.fixture(autouse=True)
def no_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setattr(line, "TERMINAL_EVERY_S", 0.0)
    monkeypatch.setattr(line, "PLAIN_EVERY_S", 0.0)


@pytest.fixture
def terminal() -> Iterator[Open]:
    """Return a function that opens a terminal of a number of columns and returns its two sides."""
    opened: list[tuple[TextIO, int]] = []

    def make(columns: int) -> tuple[TextIO, int]:
        ours, its = pty.openpty()
        opened.append((os.fdopen(its, "w", encoding="utf-8"), ours))
        resize(ours, columns)
        return opened[-1]

    yield make
    for out, ours in opened:
        out.close()
        os.close(ours)


def resize(ours: int, columns: int) -> None:
    fcntl.ioctl(ours, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))


def sent(out: TextIO, ours: int) -> str:
    """Return all that was written to a terminal."""
    out.write(END)
    out.flush()
    data = b""
    while not data.endswith(END.encode()):
        data += os.read(ours, 65_536)
    return data.decode().removesuffix(END)


def shown(out: TextIO, ours: int) -> str:
    """Return what was written to a terminal, without cursor movements."""
    return sent(out, ours).replace("\r", "").rstrip(" ")


@pytest.mark.parametrize("columns", [40, 80, 100, 250])
def test_a_line_is_cut_where_the_terminal_ends(terminal: Open, columns: int) -> None:
    out, ours = terminal(columns)
    Line(out).show(LONG)
    assert shown(out, ours) == LONG[: columns - 1].rstrip(" ")


def test_a_terminal_whose_width_is_not_known_cuts_nothing(terminal: Open) -> None:
    out, ours = terminal(0)
    Line(out).show(LONG)
    assert shown(out, ours) == LONG.rstrip(" ")


def test_the_width_that_the_user_chose_counts(terminal: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    out, ours = terminal(80)
    for chosen, width in (("120", 120), ("0", 80), ("wide", 80), ("-5", 80), ("", 80)):
        monkeypatch.setenv("COLUMNS", chosen)
        Line(out).show(LONG)
        assert shown(out, ours) == LONG[: width - 1].rstrip(" ")


def test_a_terminal_that_is_resized_is_followed(terminal: Open) -> None:
    """Nothing is written beyond the width of a terminal that became narrower, which would start another line."""
    out, ours = terminal(120)
    line = Line(out)
    line.show(LONG)
    assert len(shown(out, ours)) == len(LONG[:119].rstrip(" "))
    resize(ours, 50)
    line.show("short")
    assert len(sent(out, ours).lstrip("\r")) <= 49
    resize(ours, 200)
    line.show(LONG)
    assert len(shown(out, ours)) == len(LONG[:199].rstrip(" "))


def test_a_shorter_line_leaves_nothing_of_a_longer_one(terminal: Open) -> None:
    out, ours = terminal(80)
    line = Line(out)
    line.show("a longer line")
    line.show("short")
    line.clear()
    line.print("stays")
    assert sent(out, ours) == (
        "\ra longer line" + "\rshort        " + "\r     \r" + "stays\r\n"
    )  # fmt: skip


def test_elsewhere_lines_are_whole() -> None:
    out = io.StringIO()
    Line(out).show(LONG)
    assert out.getvalue() == LONG + "\n"


def test_what_matters_least_is_left_out_first() -> None:
    parts = [(2, "episode 1/2"), (0, "tick 5/10"), (3, "87 ticks/s"), (1, "waiting for uav-001")]
    assert fit(parts, 0) == "episode 1/2 · tick 5/10 · 87 ticks/s · waiting for uav-001"
    assert fit(parts, 50) == "episode 1/2 · tick 5/10 · waiting for uav-001"
    assert fit(parts, 35) == "tick 5/10 · waiting for uav-001"
    assert fit(parts, 12) == "tick 5/10"
    assert fit(parts, 4) == "tick"


def test_a_narrow_terminal_still_shows_the_tick_and_what_is_waited_for(terminal: Open) -> None:
    out, ours = terminal(40)
    progress = Progress(build({"training.episodes": 12}), 323, 0.0, out)
    status = Status("flying", 3, 410, 2410, 100, 1, 0.1, 150.0, 160.0, 7, 0, "uav-001")
    progress._recent = [(-10.0, 2410, 100)]
    progress.show(status)
    assert shown(out, ours) == "tick 2,410/12,000 · waiting for uav-001"


def test_what_others_are_called_cannot_move_the_cursor() -> None:
    out = io.StringIO()
    line = Line(out)
    line.show("waiting for \x1b[2J\r\nmap")
    line.print("cannot read map \x1b[31m\udcff")
    assert out.getvalue() == "waiting for \\x1b[2J\\r\\nmap\ncannot read map \\x1b[31m\\xff\n"


def closed() -> TextIO:
    out = io.StringIO()
    out.close()
    return out


class Full(io.StringIO):
    def write(self, _: str) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("out", [closed, Full])
def test_what_cannot_be_written_is_dropped(out: Callable[[], TextIO]) -> None:
    line = Line(out())
    for _ in range(3):
        line.show("waiting")
        line.share("compacting", 0.5)
        line.print("stopped")
        line.clear()


def test_a_terminal_that_is_gone_does_not_matter() -> None:
    ours, its = pty.openpty()
    out = os.fdopen(its, "w")
    line = Line(out)
    os.close(ours)
    line.show("waiting")
    line.print("stopped")
    with suppress(OSError):
        out.close()


def test_a_process_without_stderr_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", None)
    line = Line()
    line.show("waiting")
    line.print("stopped")


def test_what_takes_long_says_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    now, out = [0.0], io.StringIO()
    monkeypatch.setattr(line.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(line, "PLAIN_EVERY_S", 5.0)
    shown = Line(out, delay=2.0)
    for now[0] in (1.0, 1.9, 2.5, 3.0, 8.0):
        shown.share("reading tmc.mcap", now[0] / 10)
    assert out.getvalue().splitlines() == ["reading tmc.mcap: 25%", "reading tmc.mcap: 80%"]
