"""The faults of a mission, and when they are injected: drawn from a seed before it starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random

KILL, STOP, CUT, POWER = "kill", "stop", "cut", "power"
"""Kinds of faults.

KILL: kill -9. STOP: SIGSTOP, later SIGCONT. CUT: connections are dropped. POWER: all processes are killed at once, and
their files are cut.
"""
PAUSE_S = (0.2, 1.0)
"""Shortest and longest flight (s) without faults before a fault."""
FAULT_DURATION_S = (0.1, 1.0)
"""Shortest and longest time (s) that a process is stopped, or that connections stay cut."""
DOUBLE_KILL_SHARE = 0.2
"""Share of kills that are followed by another kill before the process has recovered."""
OTHER_FAULTS_PER_KILL = 0.35
"""Stops per kill, and cuts per kill."""


@dataclass(frozen=True)
class Fault:
    """One fault, `pause` seconds after the recovery from the last one, of the processes named `targets`.

    `seconds`: how long a stop or a cut lasts, or the time between the kills of two processes. `draw`: in [0, 1), for
    choices at the moment of the fault.
    """

    kind: str
    targets: tuple[str, ...]
    pause: float
    seconds: float
    draw: float

    @property
    def kills(self) -> int:
        """How many of the planned kills this fault is; a power cut is one."""
        return {KILL: len(self.targets), POWER: 1}.get(self.kind, 0)


def draw_faults(kills: int, seed: int, names: Sequence[str], *, power: bool) -> list[Fault]:
    """Draw faults with `kills` kills in total, of the TMC, the learner if there is one, and the UAVs equally often.

    `power`: half of the kills are power cuts.
    """
    draw, made, left = Random(seed), list[Fault](), kills
    while left:
        if power and draw.random() < 0.5:
            made.append(_fault(draw, POWER, ()))
        else:
            count = 2 if left > 1 and draw.random() < DOUBLE_KILL_SHARE else 1
            made.append(_fault(draw, KILL, tuple(_target(draw, names) for _ in range(count))))
        left -= made[-1].kills
        if draw.random() < OTHER_FAULTS_PER_KILL:
            made.append(_fault(draw, STOP, (_target(draw, names),)))
        if draw.random() < OTHER_FAULTS_PER_KILL:
            made.append(_fault(draw, CUT, ()))
    return made


def role(name: str) -> str:
    """Return the role of a process: tmc, learner or uav."""
    return name.partition("-")[0]


def _fault(draw: Random, kind: str, targets: tuple[str, ...]) -> Fault:
    return Fault(kind, targets, draw.uniform(*PAUSE_S), draw.uniform(*FAULT_DURATION_S), draw.random())


def _target(draw: Random, names: Sequence[str]) -> str:
    """Draw a process: TMC, learner and team equally often; within the team, each UAV equally often."""
    chosen = draw.choice(sorted({role(name) for name in names}))
    return draw.choice([name for name in names if role(name) == chosen])
