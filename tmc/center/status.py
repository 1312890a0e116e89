"""The progress of a mission, as the TMC tells whoever asks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tmc.center import roster
from tmc.wire.messages import Status

if TYPE_CHECKING:
    from tmc.center.station import Station


def status(station: Station) -> Status:
    """How far the mission is."""
    episode = station.episode
    return Status(
        station.phase, episode.number if episode else station.episodes, max(episode.done, 0) if episode else 0,
        station.ticks, station.rate_limiter.updates, station.policies.newest, station.loss, station.uncertainty,
        station.episode_uncertainty, station.blocked, station.rejected, roster.name_some(station.waiting_for()),
    )  # fmt: skip
