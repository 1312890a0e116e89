"""What the TMC passes on, notes or answers while the mission stays as it is."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from tmc.center.roster import uav_name
from tmc.center.status import status
from tmc.wire import messages as m

if TYPE_CHECKING:
    from tmc.center.station import Station


def beacon(station: Station, sender: str, message: m.Beacon, _now: float) -> None:
    """A UAV tells its peers where it was."""
    if uav_name(message.uav) != sender:
        station.reject(sender, "refused", f"{sender} cannot send a beacon of UAV {message.uav}")
        return
    for i in message.to.tolist():
        if i < len(station.roster) and i != message.uav:
            station.send(uav_name(i), message)


def loss(station: Station, i: int, to: Iterable[int]) -> None:
    """Tell the UAVs `to` that the team goes on without UAV i."""
    episode = station.episode
    assert episode is not None
    for j in to:
        tracks(station, j, [i])
        station.send(uav_name(j), m.Lost(episode.number, i, episode.lost[i]))


def tracks(station: Station, j: int, lost: Iterable[int]) -> None:
    """Tell UAV j, which shares no table with them, where lost UAVs were: they answer nobody any more.

    Before what tells of a loss, since from then on j does not wait for what it does not know.
    """
    episode = station.episode
    assert episode is not None
    for i in lost:
        cells = episode.cells[1 : episode.lost[i] + 1, i].copy()
        if cells.size and not station.tracks:
            station.send(uav_name(j), m.Beacon(i, episode.number, 1, cells, np.array([j], "<u2")))


def alive(station: Station, sender: str, message: m.Alive, now: float) -> None:
    """A UAV is slow, not lost. Should it have flown on from what is not known here, it must say it again.

    It may wait for a peer that waits for an exchange that a TMC that was started again cannot hold without it. And one
    that was declared lost, and is there after all, must say hello to take part in the next episode.
    """
    if not 0 <= message.uav < len(station.roster) or sender != uav_name(message.uav):
        return
    member, episode = station.roster[message.uav], station.episode
    if message.incarnation == member.incarnation:
        member.heard, member.named = now, False
        if episode is not None and message.peer in episode.lost:  # it waits for one of whose loss it has not heard
            loss(station, message.peer, [message.uav])
    elif message.incarnation in member.former:
        return  # another process flies it now
    if message.incarnation != member.incarnation or message.sequence > member.sequence + station.reorder_buffer.count(
        message.uav
    ):
        station.reject(sender, "state", f"{sender} has flown on from what is not known here: say hello")


def policy_request(station: Station, sender: str, request: m.PolicyRequest, _now: float) -> None:
    """A UAV was told to fly another policy than it has."""
    found = station.policies.find(request.version)
    if found is None:
        station.reject(sender, "state", f"there is no policy {request.version}")
    else:
        station.send(sender, m.Policy(*found))


def status_request(station: Station, sender: str, _request: m.StatusRequest, _now: float) -> None:
    """Somebody wants to know how far the mission is."""
    station.send(sender, status(station))


def bye(station: Station, sender: str, message: m.Bye, _now: float) -> None:
    """A client leaves in order."""
    if message.reason:
        station.out.notes.append(("INFO", f"{sender} leaves: {message.reason}"))
