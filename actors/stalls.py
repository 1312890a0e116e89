"""For trials: a UAV whose process stalls now and then, and how far the others run ahead of it.

Exactness means that no schedule changes what is flown. So a trial disturbs the schedule on purpose, by draws that are
addressed like all others: the same trial stalls at the same ticks.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from actors.airspace import Tracks
from tmc.kernel.config import Config
from tmc.kernel.draws import Stream, uniforms


def stalls(config: Config, uav: int) -> bool:
    """True when UAV `uav` stalls in this mission."""
    return config.trial.stall > 0 and config.trial.stall_uav in (-1, uav)


def stall(config: Config, episode: int, tick: int, uav: int) -> float:
    """Seconds that UAV `uav` stalls before it says where it is at `tick`; 0 at most ticks."""
    trial = config.trial
    chance, length = uniforms(config.training.seed, Stream.STALLS, 2, episode=episode, tick=tick, uav=uav).tolist()
    return trial.stall * (1 + trial.stall_spread * (2 * length - 1)) if chance < trial.stall_share else 0.0


class StallingTracks:
    """`Tracks` of UAV `uav` that sleep before it publishes where it is."""

    def __init__(self, tracks: Tracks, config: Config, uav: int, sleep: Callable[[float], None] = time.sleep) -> None:
        self._tracks, self._config, self._uav, self._sleep = tracks, config, uav, sleep
        self._episode = 0
        self.newest, self.at, self.lose = tracks.newest, tracks.at, tracks.lose

    def begin(self, episode: int, starts: list[int]) -> None:
        self._episode = episode
        self._tracks.begin(episode, starts)

    def publish(self, tick: int, cell: int) -> None:
        if self.at(self._uav, tick) < 0:  # otherwise a process that was started again repeats itself
            seconds = stall(self._config, self._episode, tick, self._uav)
            if seconds > 0:
                self._sleep(seconds)
        self._tracks.publish(tick, cell)


@dataclass
class Lead:
    """The farthest that a UAV has been ahead of its slowest peer, in ticks, looked at whenever it had to stop.

    `tick`: its own then; `bound`: what it stopped for: distance (a peer that could be near), exchange, or end.
    """

    most: int = 0
    tick: int = 0
    bound: str = ""

    def note(self, lead: int, tick: int, bound: str) -> None:
        """It stops at `tick`, `lead` ticks ahead."""
        if lead > self.most:
            self.most, self.tick, self.bound = lead, tick, bound
