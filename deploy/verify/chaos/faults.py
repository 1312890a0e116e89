"""What is done to a mission, and when: drawn from a seed before it begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random

KILL, STOP, CUT, POWER = "kill", "stop", "cut", "power"
"""kill -9; SIGSTOP and SIGCONT; connections are dropped; all processes are killed at once and their files are cut."""
PAUSE_S = (0.2, 1.0)
"""Seconds of undisturbed flight before a fault, at least and at most."""
FAULT_DURATION_S = (0.1, 1.0)
"""Seconds that a process is stopped, or that connections stay cut."""
TWICE = 0.2
"""Share of kills that are followed by another one before its process is back."""
BESIDE = 0.35
"""Stops a kill, and cuts a kill."""


@dataclass(frozen=True)
class Fault:
    """One thing that is done: `pause` seconds after the last one was got over, to these processes by name.

    `seconds`: how long a stop or a cut lasts, or how long after the first process a second one is killed. `draw`: in
    [0, 1), for what is chosen on the spot.
    """

    kind: str
    targets: tuple[str, ...]
    pause: float
    seconds: float
    draw: float

    @property
    def kills(self) -> int:
        """How many of the kills that were asked for it stands for; a power cut for one."""
        return {KILL: len(self.targets), POWER: 1}.get(self.kind, 0)


def draw_faults(kills: int, seed: int, names: Sequence[str], *, power: bool) -> list[Fault]:
    """Blows with so many kills in all, to the TMC, the learner if there is one, and the UAVs, each as often.

    `power`: half of the kills are power cuts.
    """
    draw, made, left = Random(seed), list[Fault](), kills
    while left:
        if power and draw.random() < 0.5:
            made.append(_fault(draw, POWER, ()))
        else:
            count = 2 if left > 1 and draw.random() < TWICE else 1
            made.append(_fault(draw, KILL, tuple(_target(draw, names) for _ in range(count))))
        left -= made[-1].kills
        if draw.random() < BESIDE:
            made.append(_fault(draw, STOP, (_target(draw, names),)))
        if draw.random() < BESIDE:
            made.append(_fault(draw, CUT, ()))
    return made


def role(name: str) -> str:
    """tmc, learner or uav."""
    return name.partition("-")[0]


def _fault(draw: Random, kind: str, targets: tuple[str, ...]) -> Fault:
    return Fault(kind, targets, draw.uniform(*PAUSE_S), draw.uniform(*FAULT_DURATION_S), draw.random())


def _target(draw: Random, names: Sequence[str]) -> str:
    """The TMC, the learner and the team are hit equally often; within the team, all alike."""
    chosen = draw.choice(sorted({role(name) for name in names}))
    return draw.choice([name for name in names if role(name) == chosen])
