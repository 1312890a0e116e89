"""Live progress of a mission: one line that is overwritten on a terminal, plain lines elsewhere."""

from __future__ import annotations

import os
import time
from typing import Any, TextIO

import zmq

from deploy.run.line import Line, Part
from tmc.kernel.config import Config
from tmc.wire import messages as m
from tmc.wire import process, sockets
from tmc.wire.codec import CodecError


class StatusPoller:
    """Polls the status of the TMC, without waiting."""

    def __init__(self, endpoint: str) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self._sock = sockets.dealer(self._context, endpoint, f"observer-{os.getpid():d}")

    def ask(self) -> m.Status | None:
        """Return the newest status received, None without one; request the next."""
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
        self._line = Line(out)
        self._total = config.training.episodes * config.training.ticks
        self._recent: list[tuple[float, int, int]] = []
        self._work_started_at = 0.0

    def show(self, status: m.Status) -> None:
        """Show a status, if a line is due."""
        self._recent = [*self._recent[-120:], (time.monotonic(), status.ticks, status.updates)]
        if self._line.due():
            self._line.show(*self.parts(status))

    def parts(self, s: m.Status) -> list[Part]:
        """Return a status as parts of a line; position, what it waits for and the time left have the lowest ranks."""
        if s.phase == "gathering":
            return [(0, f"waiting for {s.waiting or 'the first tick'}")]
        ticks, updates = self._rates()
        parts = [(2, f"episode {s.episode}/{self.config.training.episodes}"), (0, f"tick {s.ticks:,}/{self._total:,}")]
        parts += [(6, f"{ticks:,.0f} ticks/s")]
        parts += [(7, f"{updates:,.0f} updates/s")] if s.updates else []
        parts += [(5, f"uncertainty {s.uncertainty / self.cells:.3f} per cell")]
        if s.episode_uncertainty:
            times = f" ({s.episode_uncertainty / self.bound:.2f} x bound)" if self.bound else ""
            parts += [(8, f"last episode {s.episode_uncertainty / self.cells:.3f}{times}")]
        left = self._total - s.ticks
        parts += [(3, f"{clock(left / ticks)} left")] if ticks > 0 and left else []
        parts += [(4, "the learner catches up")] if s.phase == "learning" else []
        parts += [(1, f"waiting for {s.waiting}")] if s.waiting and self._is_stalled() else []
        return parts

    def _rates(self) -> tuple[float, float]:
        """Return ticks and updates per second over the last half minute."""
        recent = [p for p in self._recent if p[0] > self._recent[-1][0] - 30]
        span = recent[-1][0] - recent[0][0]
        if span <= 0:
            return 0.0, 0.0
        return (recent[-1][1] - recent[0][1]) / span, (recent[-1][2] - recent[0][2]) / span

    def _is_stalled(self) -> bool:
        """Return whether no tick became final for two seconds; then the line names what the mission waits for."""
        now, ticks = self._recent[-1][0], self._recent[-1][1]
        before = [past for past in self._recent if past[0] < now - 2]
        return bool(before) and before[-1][1] == ticks

    def work(self, what: str, share: float) -> None:
        """Show which share of work after the flight is done, once it has taken two seconds."""
        now = time.monotonic()
        self._work_started_at = self._work_started_at or now
        if now > self._work_started_at + 2.0:
            self._line.share(what, share)

    def note(self, text: str) -> None:
        """Print a line that stays."""
        self._line.print(f"{process.ERROR}{text}")

    def clear(self) -> None:
        """Erase the line of progress."""
        self._line.clear()


class NoProgress(Progress):
    """Shows nothing: neither progress nor notes."""

    def show(self, status: m.Status) -> None: ...

    def work(self, what: str, share: float) -> None: ...

    def note(self, text: str) -> None: ...


def clock(seconds: float) -> str:
    """Return seconds as h:mm:ss or m:ss."""
    minutes, s = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{s:02d}" if hours else f"{minutes}:{s:02d}"
