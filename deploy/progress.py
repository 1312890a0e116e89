"""Live progress of a mission: one line that is written over on a terminal, plain lines elsewhere."""

from __future__ import annotations

import os
import sys
import time
from typing import Any, TextIO

import zmq

from tmc.kernel.config import Config
from tmc.wire import messages as m
from tmc.wire import sockets
from tmc.wire.codec import CodecError

PLAIN_EVERY = 5.0
"""Seconds between two lines where the output is no terminal."""


class Observer:
    """Asks the TMC how far it is, and never waits for the answer."""

    def __init__(self, endpoint: str) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self._sock = sockets.dealer(self._context, endpoint, f"observer-{os.getpid():d}")

    def ask(self) -> m.Status | None:
        """The newest answer that has come in; asks for the next."""
        status = None
        try:
            while (message := sockets.receive_message(self._sock)) is not None:
                status = message if isinstance(message, m.Status) else status
        except CodecError:
            pass
        sockets.send(self._sock, m.StatusRequest())
        return status

    def close(self) -> None:
        self._context.destroy(linger=0)


class Progress:
    """Shows the status: where the mission is, its rates, its uncertainty, and the time left."""

    def __init__(self, config: Config, cells: int, bound: float, out: TextIO | None = None) -> None:
        self.config, self.cells, self.bound = config, cells, bound
        self._out = out or sys.stderr
        self._tty = self._out.isatty()
        self._total = config.training.episodes * config.training.ticks
        self._past: list[tuple[float, int, int]] = []
        self._next = self._width = self._working = 0.0

    def show(self, status: m.Status) -> None:
        """Show a status, when it is time to."""
        now = time.monotonic()
        self._past = [*self._past[-120:], (now, status.ticks, status.updates)]
        if now < self._next:
            return
        self._next = now + (0.2 if self._tty else PLAIN_EVERY)
        self._write(self.line(status))

    def line(self, s: m.Status) -> str:
        """One status as text."""
        if s.phase == "gathering":
            return f"waiting for {s.waiting or 'the first tick'}"
        ticks, updates = self._rates()
        parts = [f"episode {s.episode}/{self.config.training.episodes}", f"tick {s.ticks:,}/{self._total:,}"]
        parts += [f"{ticks:,.0f} ticks/s"]
        parts += [f"{updates:,.0f} updates/s"] if s.updates else []
        parts += [f"uncertainty {s.uncertainty / self.cells:.3f} a cell"]
        if s.episode_uncertainty:
            times = f" ({s.episode_uncertainty / self.bound:.2f} x bound)" if self.bound else ""
            parts += [f"last episode {s.episode_uncertainty / self.cells:.3f}{times}"]
        left = self._total - s.ticks
        parts += [f"{clock(left / ticks)} left"] if ticks > 0 and left else []
        parts += ["the learner catches up"] if s.phase == "learning" else []
        parts += [f"waiting for {s.waiting}"] if s.waiting and self._stands_still() else []
        return " · ".join(parts)

    def _rates(self) -> tuple[float, float]:
        """Ticks and updates a second over the last half minute."""
        recent = [p for p in self._past if p[0] > self._past[-1][0] - 30]
        span = recent[-1][0] - recent[0][0]
        if span <= 0:
            return 0.0, 0.0
        return (recent[-1][1] - recent[0][1]) / span, (recent[-1][2] - recent[0][2]) / span

    def _stands_still(self) -> bool:
        """True when no tick was finished for two seconds: then the slow ones are named."""
        now, ticks = self._past[-1][0], self._past[-1][1]
        before = [past for past in self._past if past[0] < now - 2]
        return bool(before) and before[-1][1] == ticks

    def work(self, what: str, share: float) -> None:
        """Show how much of something is done that comes after the flight, once it has taken some time."""
        now = time.monotonic()
        self._working = self._working or now
        if now > max(self._next, self._working + 2.0):
            self._next = now + (0.2 if self._tty else PLAIN_EVERY)
            self._write(f"{what}: {share:.0%}")

    def note(self, text: str) -> None:
        """A line that stays."""
        self.clear()
        print(f"overfly: {text}", file=self._out, flush=True)

    def _write(self, text: str) -> None:
        if self._tty:
            columns = os.get_terminal_size(self._out.fileno()).columns - 1
            text = text[:columns]
            self._out.write("\r" + text.ljust(int(self._width)))
            self._width = len(text)
            self._out.flush()
        else:
            print(text, file=self._out, flush=True)

    def clear(self) -> None:
        """End the line that is written over."""
        if self._tty and self._width:
            self._out.write("\r" + " " * int(self._width) + "\r")
            self._width = 0


def clock(seconds: float) -> str:
    """Seconds as h:mm:ss or m:ss."""
    minutes, s = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{s:02d}" if hours else f"{minutes}:{s:02d}"
