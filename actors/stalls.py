"""For trials: stalls of a UAV's process, and how far the others run ahead of it.

Exactness means that no schedule changes what is flown, so a trial disturbs the schedule on purpose. Its draws are
addressed like all others, so the same trial stalls at the same ticks.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from actors.airspace import Tracks
from tmc.kernel.config import Config
from tmc.kernel.draws import Stream, uniforms


def can_stall(config: Config, uav: int) -> bool:
    """Return whether UAV `uav` may stall in this mission."""
    return config.trial.stall > 0 and config.trial.stall_uav in (-1, uav)


def stall_s(config: Config, episode: int, tick: int, uav: int) -> float:
    """Return how long (s) UAV `uav` stalls before it publishes its position at `tick`; 0 at most ticks."""
    trial = config.trial
    chance, length = uniforms(config.training.seed, Stream.STALLS, 2, episode=episode, tick=tick, uav=uav).tolist()
    return trial.stall * (1 + trial.stall_spread * (2 * length - 1)) if chance < trial.stall_share else 0.0


class StallingTracks:
    """Wraps the `Tracks` of UAV `uav`; sleeps before it publishes a position. `sleep` takes seconds."""

    def __init__(self, tracks: Tracks, config: Config, uav: int, sleep: Callable[[float], None] = time.sleep) -> None:
        self._tracks, self._config, self._uav, self._sleep = tracks, config, uav, sleep
        self._episode = 0
        self.newest, self.at, self.drop_peer = tracks.newest, tracks.at, tracks.drop_peer

    def start_episode(self, episode: int, starts: list[int]) -> None:
        self._episode = episode
        self._tracks.start_episode(episode, starts)

    def publish(self, tick: int, cell: int) -> None:
        if self.at(self._uav, tick) < 0:  # a restarted process publishes known positions again, without stalls
            seconds = stall_s(self._config, self._episode, tick, self._uav)
            if seconds > 0:
                self._sleep(seconds)
        self._tracks.publish(tick, cell)


@dataclass
class Lead:
    """The largest lead of a UAV over its slowest peer, in ticks, at the moments when it had to wait.

    `tick`: its own tick then. `bound`: what it waited for: "distance" (a peer that could be near), "exchange" or "end".
    """

    ticks: int = 0
    tick: int = 0
    bound: str = ""

    def update(self, lead: int, tick: int, bound: str) -> None:
        """Keep this lead (ticks) if it is the largest so far."""
        if lead > self.ticks:
            self.ticks, self.tick, self.bound = lead, tick, bound
