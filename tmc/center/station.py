"""The traffic management centre as a core without I/O: a message comes in, messages, journal entries and notes go out.

It holds the roster, the state of the current episode, the replay memory, the rate limiter and the newest policy. Time
is an argument and randomness is addressed, so the same messages give the same answers again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from tmc.center import entries, roster
from tmc.center.episode import EpisodeState, Exchange, FinalTicks, RefusedError
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
    """Hold the TMC's state.

    `learning`: True if a learner takes part; `policy`: the policy file to fly if none does; `tracks`: the path of the
    track table that the UAVs on this machine share, empty if they tell each other their positions by beacon.
    """

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
        self._ended = False
        self.playing = False
        """True while a journal is played (tmc.center.recovery): episodes then begin where the journal says so."""
        self.sample_queue = SampleQueue(self.replay, self.rate_limiter, config.dqn.batch_size)
        self.policies, self.out = Policies(), Outbox()
        self._held: list[tuple[str, m.Message]] = []
        if policy is not None:
            self.take_policy(1, policy, 0, 0.0)

    # What the world sees of it.

    @property
    def phase(self) -> str:
        """Return gathering (a client is missing), flying, learning (the learner catches up), or done."""
        if self.episode is not None:
            return "flying"
        if self.episodes < self.config.training.episodes:
            return "gathering"
        return "learning" if self.rate_limiter.samples_due and len(self.replay) else "done"

    def waiting_for(self) -> list[str]:
        """Return the clients that hold the mission up: those missing, UAVs whose record is due next, or the learner."""
        if self.episode is None:
            if self.phase != "gathering":
                return []
            missing = [uav_name(i) for i in roster.away(self.roster)]
            return missing + ([LEARNER] if self.learning and not self.policies.newest else [])
        episode, t = self.episode, self.episode.next_exchange
        if not self.rate_limiter.can_insert and len(self.replay):
            return [LEARNER]  # the UAVs' answers are held back until it catches up
        return [uav_name(i) for i in episode.due(t) if episode.reported[i] < t]

    # Messages in.

    def handle(self, sender: str, message: m.Message, now: float) -> None:
        """Act on one message from `sender` at time `now` (s); everything that follows from it is in `out`."""
        self.answer(sender, message, now)
        self.finalise()

    def answer(self, sender: str, message: m.Message, now: float) -> None:
        """Do what a client may wait for, and leave the rest of `handle` to `finalise`, which must be called next."""
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
        """Count and note a frame that changes nothing, and send its sender an Error that says what was wrong."""
        self.rejected += 1
        self.out.notes.append(("WARNING", f"rejected a frame from {sender}: {text}"))
        self.send(sender, m.Error(code=code, text=text[:1024], incarnation=incarnation))

    def _hello(self, sender: str, hello: m.Hello, now: float) -> None:
        config = json.dumps(flat(self.config))
        number = self.roster[hello.uav].sequence if 0 <= hello.uav < len(self.roster) else 0
        welcome = m.Welcome(
            config=config,
            map=self.world.map.fingerprint,
            run=self.run,
            tracks=self.tracks,
            policy=self.policies.newest,
            sequence=number,
        )
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
            self.send(sender, m.End(reason=GOODBYE, acknowledged=self.roster[hello.uav].durable))
        elif self.episode is not None:
            if hello.uav not in self.episode.lost:  # a UAV that was lost takes part from the next episode on
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
        if record.sequence < following:  # a repeat: known, and perhaps answered
            if member.answer is not None and member.answer.sequence == record.sequence:
                self.send(sender, member.answer)
            elif episode is not None and record.episode < episode.number:  # the UAV has not heard of this episode
                self._resume(record.uav)
        elif episode is None or record.episode != episode.number or record.sequence > following:
            self.reject(sender, "state", f"record {record.sequence} of {sender} is not the next one")
        else:
            self.reorder_buffer.keep(record)
            self._accept_ready(episode)

    def _accept_ready(self, episode: EpisodeState) -> None:
        """Accept every record whose turn has come, and reject those that cannot be true."""
        while self.episode is episode:
            record = self.reorder_buffer.pop_ready(episode.next_exchange, episode.reported)
            if record is None:
                return
            try:
                self.accept(episode, record)
            except RefusedError as refused:
                self.reorder_buffer.drop(record.uav)
                self.reject(uav_name(record.uav), "refused", str(refused))

    def accept(self, episode: EpisodeState, record: m.Record) -> None:
        """Accept a UAV's next record, with all that follows from it. Raises RefusedError, and then changes nothing."""
        episode.accept(record)
        self.roster[record.uav].sequence += 1
        self.out.entries.append(entries.flight_record(record))
        self._exchange(episode)

    def finalise(self) -> None:
        """Journal the ticks that became final, end the episode when it is over, and serve the learner."""
        if self.episode is not None:
            self._journal_ticks(self.episode, self.episode.finalise())
            if self.episode.over:
                self._end_episode(self.episode)
        self._serve()

    @property
    def finalise_now(self) -> bool:
        """Return True when the team may wait for `finalise`: for the rate limiter, or at an episode's end."""
        return self.learning or self.episode is None or self.episode.next_exchange > self.episode.T

    def _exchange(self, episode: EpisodeState) -> None:
        """Answer the exchanges for which all records are in."""
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

    def _journal_ticks(self, episode: EpisodeState, final: FinalTicks) -> None:
        if not final.uncertainty:
            return
        moves = len(final.uncertainty) - (final.first == 0)
        self.ticks += moves
        self.steps += sum(final.present[-moves:]) if moves else 0
        self.rate_limiter.insert(moves, len(self.replay))
        self.uncertainty = final.uncertainty[-1]
        updates = self.rate_limiter.updates
        self.out.entries += entries.final_ticks(episode, final, self.steps, updates, self.policies.newest)

    # Episodes.

    def _try_begin(self) -> None:
        if self.phase == "gathering" and not self.waiting_for():
            self.begin_episode(roster.away(self.roster))

    def begin_episode(self, away: list[int]) -> None:
        """Begin the next episode without the UAVs in `away`; does nothing when all of them are away."""
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
            return  # the rate limiter holds the team back: this UAV hears with the others, or says hello again
        self._send_tracks(episode, i, episode.lost)
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
        """End the mission once the last episode is over and journalled, and the learner has caught up."""
        if self.phase != "done" or any(member.durable < member.sequence for member in self.roster):
            return
        if self.learning and not self.sample_queue.told_the_end:
            self.sample_queue.told_the_end = True
            self.send(LEARNER, m.End(reason=GOODBYE))
        if not self._ended:
            self._ended = True
            self._held += [
                (uav_name(i), m.End(reason=GOODBYE, acknowledged=uav.durable)) for i, uav in enumerate(self.roster)
            ]
            self._release()

    def committed(self) -> None:
        """Note that everything journalled so far is as safe as `journal.durability` says, and may be acknowledged."""
        for member in self.roster:
            member.durable = member.sequence
        self._finish_if_done()

    # Answers held back by the rate limiter.

    def _release(self) -> None:
        """Send the answers that are held back, unless the team must wait for the learner.

        It does not wait while there is nothing to learn from.
        """
        if self.rate_limiter.can_insert or self.episode is None or not len(self.replay):
            for to, message in self._held:
                if isinstance(message, m.Map):
                    self.roster[int(to[4:])].answer = message
                self.send(to, message)
            self._held.clear()

    def send(self, to: str, message: m.Message) -> None:
        """Put a message for a client into the outbox."""
        self.out.sends.append((to, message))

    # The learner.

    def _sample_request(self, sender: str, request: m.SampleRequest, _now: float) -> None:
        problem = self.sample_queue.ask(request)
        if problem is None:
            self._serve()
        else:
            self.reject(sender, "refused", problem)

    def _serve(self) -> None:
        """Answer minibatch requests as far as the rate limiter allows."""
        for minibatch in self.sample_queue.serve(self.episodes, self.ticks):
            self.send(LEARNER, minibatch)
        self._release()
        self._finish_if_done()

    def _policy_push(self, sender: str, push: m.PolicyPush, _now: float) -> None:
        if push.version <= self.policies.newest:
            self.reject(sender, "refused", f"policy {push.version} is not newer than {self.policies.newest}")
            return
        self.take_policy(push.version, push.model, push.updates, push.loss, push.sent)
        self.send(sender, m.Ack(version=push.version))
        self._try_begin()

    def take_policy(self, version: int, model: bytes, updates: int, loss: float, sent: int = 0) -> None:
        """Keep a newer policy. While a journal is played, `model` is empty if its file is gone."""
        self.policies.take(version, model, (member.policy for member in self.roster))
        self.loss = loss
        self.out.entries.append(entries.policy(version, updates, loss, model, sent, last=self._ended))

    # Silence.

    def tick(self, now: float) -> None:
        """Name each UAV that has been silent for some time, once, and go on without those silent for long."""
        episode, patience = self.episode, self.config.comms.silence_warning
        if episode is None:
            return
        for i in roster.silent(self.roster, now, patience):
            text = f"has been silent for {patience:g} s at tick {episode.next_exchange}; others wait"
            self.out.notes.append(("WARNING", f"{uav_name(i)} {text}"))
        for i in roster.long_silent(self.roster, now, self.config.comms.lost_after):
            if i in episode.lost:  # it had come back, for the next episode
                self.roster[i].incarnation = -1
            elif self.episode is episode:  # else the first of them ended the episode
                self.lose(episode, i)
                self._accept_ready(episode)
                self.finalise()

    def lose(self, episode: EpisodeState, i: int) -> None:
        """Go on without a UAV for the rest of the episode."""
        self.roster[i].incarnation = -1  # a process that comes back says hello first
        self.reorder_buffer.drop(i)
        last = episode.lose(i)
        self.out.entries.append(entries.lost(episode, i))
        text = f"{uav_name(i)} is lost after tick {last} of episode {episode.number}; the others go on without it"
        self.out.notes.append(("ERROR", text))
        self._send_loss(episode, i, range(episode.N))
        self._exchange(episode)

    def _send_loss(self, episode: EpisodeState, i: int, to: Iterable[int]) -> None:
        """Tell the UAVs `to` that the team goes on without UAV i."""
        for j in to:
            self._send_tracks(episode, j, [i])
            self.send(uav_name(j), m.Lost(episode=episode.number, uav=i, tick=episode.lost[i]))

    def _send_tracks(self, episode: EpisodeState, j: int, lost: Iterable[int]) -> None:
        """Tell UAV j the recorded tracks of lost UAVs, which no longer answer it, unless it shares a table with them.

        Sent before the loss itself: from then on UAV j does not wait for what it does not know.
        """
        if self.tracks:
            return
        for i in lost:
            cells = episode.cells[1 : episode.lost[i] + 1, i].copy()
            if cells.size:
                to = np.array([j], "<u2")
                self.send(uav_name(j), m.Beacon(uav=i, episode=episode.number, tick=1, cells=cells, to=to))

    # What is passed on or answered while the mission stays as it is.

    def _beacon(self, sender: str, beacon: m.Beacon, _now: float) -> None:
        if uav_name(beacon.uav) != sender:
            self.reject(sender, "refused", f"{sender} cannot send a beacon of UAV {beacon.uav}")
            return
        for i in beacon.to.tolist():
            if i < len(self.roster) and i != beacon.uav:
                self.send(uav_name(i), beacon)

    def _alive(self, sender: str, alive: m.Alive, now: float) -> None:
        """Note that a UAV is slow, not lost.

        A UAV that has flown on from what is not known here must say hello: it may wait for a peer that waits for an
        exchange which a restarted TMC cannot hold without its record. So must one that was declared lost: it takes part
        from the next episode on.
        """
        if not 0 <= alive.uav < len(self.roster) or sender != uav_name(alive.uav):
            return
        member, episode = self.roster[alive.uav], self.episode
        if alive.incarnation in member.former:
            return  # a newer process flies this UAV
        current = alive.incarnation == member.incarnation
        if current:
            member.heard, member.named = now, False
            if episode is not None and alive.peer in episode.lost:  # it has not heard of that loss
                self._send_loss(episode, alive.peer, [alive.uav])
        if not current or alive.sequence > member.sequence + self.reorder_buffer.count(alive.uav):
            self.reject(sender, "state", f"{sender} has flown on from what is not known here: say hello")

    def _policy_request(self, sender: str, request: m.PolicyRequest, _now: float) -> None:
        found = self.policies.find(request.version)
        if found is None:
            self.reject(sender, "state", f"there is no policy {request.version}")
        else:
            version, model = found
            self.send(sender, m.Policy(version=version, model=model))

    def status(self) -> m.Status:
        """Return how far the mission is."""
        episode = self.episode
        return m.Status(
            phase=self.phase,
            episode=episode.number if episode else self.episodes,
            tick=max(episode.done, 0) if episode else 0,
            ticks=self.ticks,
            updates=self.rate_limiter.updates,
            policy=self.policies.newest,
            loss=self.loss,
            uncertainty=self.uncertainty,
            episode_uncertainty=self.episode_uncertainty,
            blocked=self.blocked,
            rejected=self.rejected,
            waiting=roster.name_some(self.waiting_for()),
        )

    def _status_request(self, sender: str, _request: m.StatusRequest, _now: float) -> None:
        self.send(sender, self.status())

    def _bye(self, sender: str, bye: m.Bye, _now: float) -> None:
        if bye.reason:
            self.out.notes.append(("INFO", f"{sender} leaves: {bye.reason}"))


_HANDLERS: dict[type[m.Message], Callable[[Station, str, Any, float], None]] = {
    m.Hello: Station._hello,
    m.Record: Station._record,
    m.SampleRequest: Station._sample_request,
    m.PolicyPush: Station._policy_push,
    m.PolicyRequest: Station._policy_request,
    m.Alive: Station._alive,
    m.Beacon: Station._beacon,
    m.StatusRequest: Station._status_request,
    m.Bye: Station._bye,
}
