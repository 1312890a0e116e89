"""Decides which messages must wait for a commit of the journal, and when a newer policy may be named.

Answers are sent before they are committed, since a restarted TMC gives the same answers again. Three cases are
different, because a client acts on them in a way that a restarted TMC could not know of:

- *binding*: a UAV that hears of a new episode forgets where it was in the last one; one that hears of a loss stops
  looking out for the lost UAV;
- *another policy*: if TMC and UAV are killed, the UAV's next process must be told the same policy, since peers may have
  seen where the last one flew;
- *far ahead*: in a training, answers are at most `MAX_TICKS_UNCOMMITTED` ticks ahead of the journal.
"""

from __future__ import annotations

from collections.abc import Sequence

from tmc.center.station import Station
from tmc.wire.messages import Begin, Lost, Map, Message

MAX_TICKS_UNCOMMITTED = 100
"""Ticks by which answers are ahead of the journal at most, in a training.

A restarted TMC therefore knows up to which tick its last incarnation may have answered. Up to there it names the policy
that the last one named.
"""


def is_binding(message: Message) -> bool:
    """Return True if a restarted TMC must know that this was sent: a loss, or the start of a new episode."""
    return isinstance(message, Lost) or (isinstance(message, Begin) and message.shipped < 0)


class CommitGate:
    """Follow what was answered and what is committed; `resumed`: an earlier incarnation of the TMC left a journal.

    Times here are ticks since the mission began, each episode's last tick included.
    """

    def __init__(self, station: Station, *, resumed: bool) -> None:
        self._station = station
        self._flown_policies: dict[str, int] = {}
        """The policy that each UAV was last told to fly; all of that is committed."""
        self._answered = self._committed = 0
        self._repeats_until = self._next_exchange() + MAX_TICKS_UNCOMMITTED if resumed else 0
        """Up to here an earlier incarnation may have answered."""

    def must_commit(self, sends: Sequence[tuple[str, Message]]) -> bool:
        """Return True if the journal must be committed before these (client, message) are sent."""
        answers = [(name, message) for name, message in sends if isinstance(message, Begin | Map)]
        policies = {name: answer.policy for name, answer in answers}
        self._answered = max([self._answered, *(self._ticks(a.episode, a.tick) for _, a in answers)])
        far_ahead = self._station.learning and self._answered > self._committed + MAX_TICKS_UNCOMMITTED
        another_policy = any(self._flown_policies.get(name, 0) != policy for name, policy in policies.items())
        self._flown_policies |= policies
        return far_ahead or another_policy or any(is_binding(message) for _, message in sends)

    def committed(self) -> None:
        """Note that everything answered so far is committed."""
        self._committed = self._answered

    @property
    def policy_may_change(self) -> bool:
        """False while exchanges may be repeated that an earlier incarnation has answered with the policy named now.

        True whenever that policy is not at hand, or none will be named any more.
        """
        station = self._station
        over = station.phase in {"learning", "done"}
        gone = station.policies.find(station.policies.newest) is None
        return self._answered >= self._repeats_until or over or gone

    def _next_exchange(self) -> int:
        episode = self._station.episode
        if episode is None:
            return self._ticks(self._station.episodes + 1, 0)
        return self._ticks(episode.number, episode.next_exchange)

    def _ticks(self, episode: int, tick: int) -> int:
        return episode * (self._station.config.training.ticks + 1) + tick
