"""The progress of a mission, as the TMC tells whoever asks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tmc.center import roster
from tmc.wire.messages import Status

if TYPE_CHECKING:
    from tmc.center.station import Station


def status(station: Station) -> Status:
    """How far the mission is."""
    flight = station.flight
    return Status(
        station.phase, flight.episode if flight else station.episodes, max(flight.done, 0) if flight else 0,
        station.ticks, station.limiter.updates, station.policies.newest, station.loss, station.uncertainty,
        station.episode_uncertainty, station.blocked, station.rejected, roster.name_some(station.waiting_for()),
    )  # fmt: skip
