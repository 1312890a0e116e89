"""The traffic management centre as a core without I/O: a message comes in, messages, journal entries and notes go out.

It holds the roster, the episode of the current episode, the replay memory, the limiter and the newest policy. Time is
an argument and randomness is addressed, so playing the same messages again gives the same answers.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from tmc.center import entries, relay, roster
from tmc.center.episode import EpisodeState, Exchange, FinalTicks
from tmc.center.policies import Policies
from tmc.center.rate_limiter import RateLimiter
from tmc.center.reorder_buffer import ReorderBuffer
from tmc.center.replay import Replay
from tmc.center.roster import LEARNER, Member, Outbox, uav_name
from tmc.center.sample_queue import REPLACED, SampleQueue
from tmc.kernel.config import flat
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.reward import Block, RewardLaw
from tmc.kernel.world import World
from tmc.wire import messages as m

GOODBYE = "the mission is over"


class Station:
    """The TMC's state. `learning`: whether a learner takes part; `policy`: the file to fly when none does."""

    def __init__(
        self, world: World, run: str, *, learning: bool, policy: bytes | None = None, tracks: str = ""
    ) -> None:
        config = world.config
        self.world, self.config, self.run, self.tracks = world, config, run, tracks
        self.learning = learning and policy is None and config.team.controller == "policy"
        self.observer = ObservationBuilder(world)
        self.replay = Replay(world, self.observer)
        self.reward = RewardLaw(config, world.law.q)
        ratio = config.replay.updates_per_tick if self.learning else 0.0
        self.rate_limiter = RateLimiter(ratio, config.replay.error_buffer, config.replay.learn_start)
        self.roster, self.reorder_buffer = [Member() for _ in range(config.team.size)], ReorderBuffer()
        self.episode: EpisodeState | None = None
        self.version = self.ticks = self.steps = self.episodes = self.rejected = self.blocked = self.blocked_by_uav = 0
        self.uncertainty = self.episode_uncertainty = self.loss = 0.0
        self.playing = self._ended = (
            False  # playing: a journal (tmc.center.recovery): then episodes begin where it says so
        )
        self.sample_queue = SampleQueue(self.replay, self.rate_limiter, config.dqn.batch_size)
        self.policies, self.out = Policies(), Outbox()
        self._held: list[tuple[str, m.Message]] = []
        if policy is not None:
            self.take_policy(1, policy, 0, 0.0)

    # What the world sees of it.

    @property
    def phase(self) -> str:
        """gathering (not everybody is here), flying, learning (the learner catches up), or done."""
        if self.episode is not None:
            return "flying"
        if self.episodes < self.config.training.episodes:
            return "gathering"
        return "learning" if self.rate_limiter.samples_due and len(self.replay) else "done"

    def waiting_for(self) -> list[str]:
        """PolicySpec keeps the mission from going on: who is not here yet, UAVs whose record is due next, or the
        learner.
        """
        if self.episode is None:
            if self.phase != "gathering":
                return []
            missing = [uav_name(i) for i in roster.away(self.roster)]
            return missing + ([LEARNER] if self.learning and not self.policies.newest else [])
        episode, t = self.episode, self.episode.next_exchange
        if not self.rate_limiter.can_insert and len(self.replay):
            return [LEARNER]  # it keeps the UAVs' answers from them
        return [uav_name(i) for i in episode.due(t) if episode.reported[i] < t]

    # Messages in.

    def handle(self, sender: str, message: m.Message, now: float) -> None:
        """Take one message from `sender` at time `now`, seconds; everything that follows from it is in `out`."""
        self.answer(sender, message, now)
        self.finalise()

    def answer(self, sender: str, message: m.Message, now: float) -> None:
        """As `handle`, but only what somebody may wait for; `settle` does the rest, and must be called next."""
        handler = _HANDLERS.get(type(message))
        if handler is None:
            self.reject(sender, "state", f"{type(message).__name__} is not a message for the TMC")
        elif isinstance(message, m.SampleRequest | m.PolicyPush) and (sender != LEARNER or not self.learning):
            self.reject(sender, "refused", f"only the learner may send a {type(message).__name__}")
        elif isinstance(message, m.SampleRequest | m.PolicyPush) and message.incarnation in self.sample_queue.former:
            self.reject(sender, *REPLACED, message.incarnation)
        else:
            handler(self, sender, message, now)

    def reject(self, sender: str, code: str, text: str, incarnation: int = 0) -> None:
        """Count and note a frame that changes nothing, and tell its sender what was wrong."""
        self.rejected += 1
        self.out.notes.append(("WARNING", f"rejected a frame from {sender}: {text}"))
        self.send(sender, m.Error(code, text[:1024], incarnation))

    def _hello(self, sender: str, hello: m.Hello, now: float) -> None:
        config = json.dumps(flat(self.config))
        number = self.roster[hello.uav].sequence if 0 <= hello.uav < len(self.roster) else 0
        welcome = m.Welcome(config, self.world.map.fingerprint, self.run, self.tracks, self.policies.newest, number)
        if hello.role == "learner":
            if not self.learning or sender != LEARNER:
                self.reject(sender, "refused", f"{sender} cannot be the learner of this mission, or it has none")
            elif hello.incarnation in self.sample_queue.former:
                self.reject(sender, *REPLACED, hello.incarnation)
            else:
                self.sample_queue.welcome(hello)
                self.send(sender, welcome)
                self._finish_if_done()
            return
        problem = roster.hello_problem(self.roster, sender, hello)
        if problem is not None:
            self.reject(sender, *problem, hello.incarnation)
            return
        if self.roster[hello.uav].heard_from(hello.incarnation, now):
            self.reorder_buffer.drop(hello.uav)
            self.out.notes.append(("WARNING", f"{sender} is back with a new process"))
        self.send(sender, welcome)
        if self._ended:
            self.send(sender, m.End(GOODBYE, self.roster[hello.uav].durable))
        elif self.episode is not None:
            if hello.uav not in self.episode.lost:  # who was lost is back with the next episode
                self._resume(hello.uav)
        else:
            self._try_begin()

    def _record(self, sender: str, record: m.Record, now: float) -> None:
        problem = roster.record_problem(self.roster, sender, record)
        if problem is not None:
            self.reject(sender, *problem, record.incarnation)
            return
        member = self.roster[record.uav]
        member.heard, member.named = now, False
        episode = self.episode
        if episode is not None and record.uav in episode.lost:
            return  # too late: the others went on without it
        following = member.sequence + self.reorder_buffer.count(record.uav)
        if record.sequence < following:  # a repeat: it is known, and perhaps answered
            if member.answer is not None and member.answer.sequence == record.sequence:
                self.send(sender, member.answer)
            elif episode is not None and record.episode < episode.number:  # it has not heard that this one began
                self._resume(record.uav)
        elif episode is None or record.episode != episode.number or record.sequence > following:
            self.reject(sender, "state", f"record {record.sequence} of {sender} is not the next one")
        else:
            self.reorder_buffer.keep(record)
            self.reorder_buffer.accept(self, episode)

    def accept(self, episode: EpisodeState, record: m.Record) -> None:
        """Take a UAV's next record, and all that follows from it; raises RefusedError, and changes nothing."""
        episode.accept(record)
        self.roster[record.uav].sequence += 1
        self.out.entries.append(entries.flight_record(record))
        self._exchange(episode)

    def finalise(self) -> None:
        """Journal what became final, end the episode when it is over, and let the learner have what it is owed."""
        if self.episode is not None:
            self._journal_truth(self.episode, self.episode.finalise())
            if self.episode.over:
                self._end_episode(self.episode)
        self._serve()

    @property
    def finalise_now(self) -> bool:
        """True when the team may wait for `settle`: for the limiter, or, when the last exchange was, for an episode."""
        return self.learning or self.episode is None or self.episode.next_exchange > self.episode.T

    def _exchange(self, episode: EpisodeState) -> None:
        """Answer the exchanges that can be held."""
        for exchange in episode.exchanges():
            self._answer(episode, exchange)
        if not self.learning:
            self._release()

    def _answer(self, episode: EpisodeState, exchange: Exchange) -> None:
        self.version = exchange.version
        self.out.entries += entries.exchange(episode, exchange, self.policies.newest)
        for i in exchange.uavs:
            member = self.roster[i]
            member.policy = self.policies.newest
            answer = episode.answer(exchange, member.policy, member.sequence - 1, member.durable)
            self._held.append((uav_name(i), answer))

    def _journal_truth(self, episode: EpisodeState, truth: FinalTicks) -> None:
        if not truth.uncertainty:
            return
        moves = len(truth.uncertainty) - (truth.first == 0)
        self.ticks += moves
        self.steps += sum(truth.present[-moves:]) if moves else 0
        self.rate_limiter.insert(moves, len(self.replay))
        self.uncertainty = truth.uncertainty[-1]
        updates = self.rate_limiter.updates
        self.out.entries += entries.truth(episode, truth, self.steps, updates, self.policies.newest)

    # Episodes.

    def _try_begin(self) -> None:
        if self.phase == "gathering" and not self.waiting_for():
            self.begin_episode(roster.away(self.roster))

    def begin_episode(self, away: list[int]) -> None:
        """The next episode, which those who are `away` have no part in; nothing when everybody is."""
        if len(away) == len(self.roster):
            return  # gather again
        self.episode = episode = EpisodeState(self.world, self.reward, self.replay, self.episodes + 1, self.version)
        self._journal_episode(episode, "begin")
        for i in away:
            self.lose(episode, i)
        for i, member in enumerate(self.roster):
            member.answer, member.policy = None, self.policies.newest
            if i not in away:
                self._held.append((uav_name(i), episode.begin(i, self.policies.newest, self.roster[i].sequence)))
        self._release()

    def _resume(self, i: int) -> None:
        episode, member = self.episode, self.roster[i]
        if episode is None or self._held:
            return  # the limiter holds the team back: it is told when the others are, or says hello again
        relay.tracks(self, i, episode.lost)
        self.send(uav_name(i), episode.begin(i, member.policy, member.sequence))
        if member.answer is not None and member.answer.tick == episode.reported[i]:
            self.send(uav_name(i), member.answer)

    def _end_episode(self, episode: EpisodeState) -> None:
        self.episodes = episode.number
        self.blocked += sum(episode.blocked.values())
        self.blocked_by_uav += episode.blocked[Block.UAV]
        self.episode_uncertainty = episode.total_uncertainty / episode.T
        self._journal_episode(episode, "end")
        self.out.entries.append(entries.state(episode, self.replay))
        self.episode = None
        if self.episodes < self.config.training.episodes and not self.playing:
            self.begin_episode(roster.away(self.roster))
        else:
            self._finish_if_done()

    def _journal_episode(self, episode: EpisodeState, phase: str) -> None:
        epsilon = self.config.epsilon(episode.number)
        self.out.entries.append(entries.episode(episode, phase, epsilon, self.steps, self.rate_limiter.updates))

    def _finish_if_done(self) -> None:
        """Send everybody home once the last episode is over and journalled, and the learner has caught up."""
        if self.phase != "done" or any(member.durable < member.sequence for member in self.roster):
            return
        if self.learning and not self.sample_queue.told_the_end:
            self.sample_queue.told_the_end = True
            self.send(LEARNER, m.End(GOODBYE))
        if not self._ended:
            self._ended = True
            self._held += [(uav_name(i), m.End(GOODBYE, uav.durable)) for i, uav in enumerate(self.roster)]
            self._release()

    def committed(self) -> None:
        """Everything journalled so far is as safe as `journal.durability` says: it may be acknowledged."""
        for member in self.roster:
            member.durable = member.sequence
        self._finish_if_done()

    # Answers held back by the limiter.

    def _release(self) -> None:
        if (
            self.rate_limiter.can_insert or self.episode is None or not len(self.replay)
        ):  # nothing to learn from: fly on
            for to, message in self._held:
                if isinstance(message, m.Map):
                    self.roster[int(to[4:])].answer = message
                self.send(to, message)
            self._held.clear()

    def send(self, to: str, message: m.Message) -> None:
        """Put a message for somebody into the outbox."""
        self.out.sends.append((to, message))

    # The learner.

    def _sample_request(self, sender: str, request: m.SampleRequest, _now: float) -> None:
        problem = self.sample_queue.ask(request)
        if problem is None:
            self._serve()
        else:
            self.reject(sender, "refused", problem)

    def _serve(self) -> None:
        """Answer minibatch requests as far as the limiter allows."""
        for minibatch in self.sample_queue.serve(self.episodes, self.ticks):
            self.send(LEARNER, minibatch)
        self._release()
        self._finish_if_done()

    def _policy_push(self, sender: str, push: m.PolicyPush, _now: float) -> None:
        if push.version <= self.policies.newest:
            self.reject(sender, "refused", f"policy {push.version} is not newer than {self.policies.newest}")
            return
        self.take_policy(push.version, push.model, push.updates, push.loss, push.sent)
        self.send(sender, m.Ack(push.version))
        self._try_begin()

    def take_policy(self, version: int, model: bytes, updates: int, loss: float, sent: int = 0) -> None:
        """A newer policy is here, or, when a journal is played, was: `model` is empty where the file is gone."""
        self.policies.take(version, model, (member.policy for member in self.roster))
        self.loss = loss
        self.out.entries.append(entries.policy(version, updates, loss, model, sent, last=self._ended))

    # Silence.

    def tick(self, now: float) -> None:
        """Name, once each, the UAVs that have been silent for some time, and go on without those silent for long."""
        episode, patience = self.episode, self.config.comms.silence_warning
        if episode is None:
            return
        for i in roster.silent(self.roster, now, patience):
            text = f"has been silent for {patience:g} s at tick {episode.next_exchange}; others wait"
            self.out.notes.append(("WARNING", f"{uav_name(i)} {text}"))
        for i in roster.long_silent(self.roster, now, self.config.comms.lost_after):
            if i in episode.lost:  # it was back, for the next episode
                self.roster[i].incarnation = -1
            elif self.episode is episode:  # else the first of them ended the episode
                self.lose(episode, i)
                self.reorder_buffer.accept(self, episode)
                self.finalise()

    def lose(self, episode: EpisodeState, i: int) -> None:
        """Go on without a UAV for the rest of the episode."""
        self.roster[i].incarnation = -1  # whoever comes back says hello first
        self.reorder_buffer.drop(i)
        last = episode.lose(i)
        self.out.entries.append(entries.lost(episode, i))
        text = f"{uav_name(i)} is lost after tick {last} of episode {episode.number}; the others go on without it"
        self.out.notes.append(("ERROR", text))
        relay.loss(self, i, range(episode.N))
        self._exchange(episode)


_HANDLERS: dict[type[m.Message], Callable[[Station, str, Any, float], None]] = {
    m.Hello: Station._hello,
    m.Record: Station._record,
    m.SampleRequest: Station._sample_request,
    m.PolicyPush: Station._policy_push,
    m.PolicyRequest: relay.policy_request,
    m.Alive: relay.alive,
    m.Beacon: relay.beacon,
    m.StatusRequest: relay.status_request,
    m.Bye: relay.bye,
}
