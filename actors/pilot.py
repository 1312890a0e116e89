"""One UAV as a core without I/O: it senses, ships its record when due, decides, moves, and names what it waits for.

Per tick t, in this order (docs/explanation/architecture.md):

1. Sense the peers nearby and update its own map.
2. At t mod T_u = phase, ship the record and merge the TMC's map.
3. Observe o(t) and choose a(t).
4. Move, unless the target is held. The new cell is visited at t + 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from actors.airspace import Airspace, Tracks
from actors.planners import Controller, LocalState, QController
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.policy import FlightError, PolicyError
from tmc.kernel.reward import Block, RewardLaw
from tmc.kernel.uncertainty import merge
from tmc.kernel.world import World
from tmc.wire.messages import EMPTY, Begin, Lost, Map, Policy, PolicyRequest, Record

NONE: NDArray[np.float32] = np.zeros(0, "<f4")
MAX_TICKS_PER_ADVANCE = 32
"""Most ticks that one call of `advance` flies."""


class LostRecordsError(Exception):
    """The TMC has lost records that it had acknowledged. Only a new process can resume the flight."""


class Phase(Enum):
    """What the pilot does next, or what it waits for."""

    IDLE = "waits for an episode"
    POLICY = "waits for a policy"
    SENSE = "senses its peers"
    MAP = "waits for the TMC's map"
    ACT = "decides"
    MOVE = "moves"


@dataclass
class RecordBuilder:
    """The moves since the last record; its fields are those of `Record`. `seen`: (tick, cell) of sensed peers."""

    first: int
    cells: list[int] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)
    blocks: list[int] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    seen: list[tuple[int, int]] = field(default_factory=list)
    values: list[float] = field(default_factory=list)


class Pilot:
    """UAV `uav` of a world.

    `make_controller` turns the bytes of a policy file into a Controller; with a `planner` it is not used. `clock`: the
    wall clock (ns) that records are stamped with; 0 without one.
    """

    def __init__(
        self,
        world: World,
        uav: int,
        incarnation: int,
        tracks: Tracks,
        observer: ObservationBuilder,
        make_controller: Callable[[bytes], Controller],
        planner: Controller | None = None,
        clock: Callable[[], int] = lambda: 0,
    ) -> None:
        self.world, self.uav, self.incarnation, self.observer = world, uav, incarnation, observer
        self.config, self.law = world.config, world.law
        self.airspace = Airspace(uav, self.config.team.size, world.grid, observer.sensing, tracks)
        self.reward, self._clock = RewardLaw(self.config, world.law.q), clock
        self.controller, self._make_controller, self._planner = planner, make_controller, planner
        self._q_controller: QController | None = None
        """The policy, if records carry Q of each move (`replay.priority_exponent` > 0)."""
        self.phase = Phase.IDLE
        self.episode = self.t = self.cell = self.previous = self.sequence = self.version = 0
        self.policy = self.wanted = 0
        self.explored = self.steps = 0
        self.pending: Record | None = None
        self.unacknowledged: list[Record] = []
        """Records that the TMC has not acknowledged as durably journalled."""

    # Messages in.

    def on_begin(self, begin: Begin) -> PolicyRequest | None:
        """Start an episode or, in a new process, resume a flight where the TMC's last record of it ends.

        Returns the request for the policy that is still missing. A repeated message is dropped.
        """
        if begin.episode <= self.episode:
            return None
        track = begin.track.tolist()
        self.episode, self.t, self.cell, self.previous = begin.episode, begin.tick, track[-1], track[-2:][0]
        self.sequence, self.version = begin.sequence, begin.version
        self.unacknowledged = [r for r in self.unacknowledged if r.sequence < begin.sequence]
        self.airspace.start_episode(self.episode, self.world.starts(self.episode))
        for uav in begin.lost.tolist():
            self.airspace.drop_peer(uav)
        self._epsilon = self.config.epsilon(self.episode)
        self._draws: list[list[float]] = self.world.explorations(self.episode, self.uav).tolist()
        self._factor = self.world.initial_factor(self.episode)
        self.last_visit = begin.last_visit.copy()
        self.active = np.zeros(self.world.grid.size, bool)
        self.visited = set(track)
        self.shipped = begin.shipped
        self.builder = RecordBuilder(begin.shipped + 1)
        self.pending, self._answered = None, False
        if begin.shipped < 0:
            self.builder.cells.append(self.cell)
        for tick, cell in enumerate(track):  # a restarted process publishes its earlier positions again
            self.airspace.tracks.publish(tick, cell)
        return self._request_policy(begin.policy, Phase.SENSE)

    def on_map(self, answer: Map) -> PolicyRequest | None:
        """Merge the TMC's answer to the record of tick t; drop any other answer. Returns the request for a policy."""
        self.acknowledge(answer.acknowledged)
        if (answer.episode, answer.tick) != (self.episode, self.t) or self.t > self.shipped or self._answered:
            return None
        if self.config.scenario == 1:
            self.active[:] = False
            self.active[answer.active] = True
        else:
            self.last_visit = merge(self.last_visit, answer.last_visit)
        self.version, self.pending, self._answered = answer.version, None, True
        # A resumed flight is answered before it has sensed its peers again.
        return self._request_policy(answer.policy, Phase.ACT if self.phase is Phase.MAP else Phase.SENSE)

    def acknowledge(self, sequence: int) -> list[Record]:
        """Note that the TMC has durably journalled the records below `sequence`; return those newly acknowledged."""
        done = [r for r in self.unacknowledged if r.sequence < sequence]
        self.unacknowledged = self.unacknowledged[len(done) :]
        return done

    def records_from(self, sequence: int) -> list[Record]:
        """Return the records to resend to a TMC that expects record `sequence` next. Raises LostRecordsError."""
        again = [r for r in self.unacknowledged if r.sequence >= sequence]
        if len(again) < self.sequence - sequence:
            raise LostRecordsError(f"the TMC asks for record {sequence}, which it had acknowledged")
        return again

    def _request_policy(self, version: int, then: Phase) -> PolicyRequest | None:
        """Return the request for policy `version`, unless it is here. A policy reaches a UAV only at an exchange.

        `then`: the phase that follows once the policy is here.
        """
        self.phase = then
        if self._planner is not None or version == self.policy:
            return None
        self.phase, self._then, self.wanted = Phase.POLICY, then, version
        return PolicyRequest(version=version)

    def on_lost(self, lost: Lost) -> None:
        """Fly on without a UAV that is lost for the rest of the episode."""
        if lost.episode == self.episode:
            self.airspace.drop_peer(lost.uav)

    def on_policy(self, policy: Policy) -> None:
        """Take over the policy that was requested. Raises PolicyError when it cannot fly here."""
        if self.phase is Phase.POLICY and policy.version >= self.wanted:
            try:
                self.controller = self._make_controller(policy.model)
            except PolicyError as error:
                raise PolicyError(f"UAV {self.uav} cannot fly policy {policy.version}: {error}") from None
            if self.config.replay.priority_exponent:
                assert isinstance(self.controller, QController)
                self._q_controller = self.controller
            self.policy, self.phase = policy.version, self._then

    # Flying.

    def advance(self) -> Record | None:
        """Fly until a record must go out (returned) or a message is needed (None). Raises Waiting for a peer.

        Also returns None after MAX_TICKS_PER_ADVANCE, so that the caller can receive and send (`under_way`).
        """
        until = self.t + MAX_TICKS_PER_ADVANCE
        while self.t < until:
            if self.phase is Phase.SENSE:
                if self._sense():
                    return self._ship()
            elif self.phase is Phase.ACT:
                self._act()
            elif self.phase is Phase.MOVE:
                self._move()
            else:
                return None
        return None

    @property
    def under_way(self) -> bool:
        """Whether the flight continues with the next call of `advance`, without a message."""
        return self.phase in (Phase.SENSE, Phase.ACT, Phase.MOVE)

    def _sense(self) -> bool:
        """Sense at t and make the local update (Sec. II-D): own cell and cells of sensed peers get tau = t.

        Returns whether a record must go out now.
        """
        if self.shipped == self.t == self.config.training.ticks:
            self.phase = Phase.IDLE  # resumed at the end of the episode; its peers may be in the next one
            return False
        self.peers = self.airspace.sense(self.t, self.cell)
        index = self.law.index_list
        for cell in (self.cell, *self.peers):
            if index[cell] >= 0:
                self.last_visit[index[cell]] = self.t
        due, fresh = self.config.due(self.uav, self.t), self.t > self.shipped
        if fresh:  # a resumed flight is at a tick that the TMC has
            self.builder.seen.extend((self.t, cell) for cell in self.peers)
        self.phase = Phase.MAP if due and not self._answered else Phase.ACT
        return due and fresh

    def _ship(self) -> Record:
        """Return the record of the moves since the last one, and keep it until it is acknowledged."""
        flown = self.builder
        seen = np.array(flown.seen, "<u2").reshape(-1, 2) if flown.seen else None
        self.pending = Record(
            uav=self.uav,
            incarnation=self.incarnation,
            sequence=self.sequence,
            episode=self.episode,
            first=flown.first,
            tick=self.t,
            version=self.version,
            policy=self.policy,
            cells=np.array(flown.cells, "<u2"),
            actions=np.array(flown.actions, "u1"),
            blocks=np.array(flown.blocks, "u1"),
            rewards=np.array(flown.rewards, "<f4"),
            seen_tick=EMPTY if seen is None else seen[:, 0].copy(),
            seen_cell=EMPTY if seen is None else seen[:, 1].copy(),
            values=np.array(flown.values, "<f4") if flown.values else NONE,
            sent=self._clock(),
        )
        self.unacknowledged.append(self.pending)
        self.sequence += 1
        self.shipped = self.t
        self.builder = RecordBuilder(self.t + 1)
        return self.pending

    def map_of(self, t: int) -> NDArray[np.float64]:
        """Return the UAV's own uncertainty map U_i(t), shape (R,)."""
        if self.config.scenario == 1:
            return self.active[self.law.cells].astype(np.float64)
        return self.law.values(self.last_visit, t, self._factor)

    def state(self) -> LocalState:
        """Return what this UAV knows at t."""
        allowed = self.observer.allowed(self.cell, self.peers)
        draw = self._draws[self.t][1]
        return LocalState(self.t, self.cell, self.previous, self.peers, self.map_of(self.t), allowed, draw)

    def _act(self) -> None:
        """Choose a(t), epsilon-greedy; at the end of the episode become idle. Raises FlightError."""
        if self.t == self.config.training.ticks:
            self.phase = Phase.IDLE
            return
        try:
            self._decide(*self._draws[self.t])
        except FlightError as error:
            where = f"UAV {self.uav} stops at tick {self.t} of episode {self.episode}"
            raise FlightError(f"{where}: policy {self.policy} {error}; train it again, or fly another one") from None
        self.phase = Phase.MOVE

    def _decide(self, explore: float, draw: float) -> None:
        """Choose the action by the draws of the tick, and its Q values if records carry them."""
        state = None
        if self._planner is None and explore < self._epsilon:
            self.explored += 1
            mask = self.config.exploration.mask_blocked
            choices = self.observer.allowed(self.cell, self.peers) if mask else range(N_ACTIONS)
            self.action = choices[int(draw * len(choices))]
        else:
            assert self.controller is not None
            state = self.state()
            self.action = self.controller.choose(state)
        if self._q_controller is not None:
            self.builder.values += self._q_controller.q_of(state or self.state(), self.action)

    def _move(self) -> None:
        """Move to the target of a(t), or stay when it is blocked or held. Raises Waiting for a peer."""
        cell, block = self.world.moves[self.cell][self.action]
        if not block and self.airspace.is_held(self.t, self.cell, cell):
            cell, block = self.cell, Block.UAV
        k = self.law.index_list[cell]
        u = self._before_visit(k, cell) if k >= 0 else 0.0
        self.builder.rewards.append(self.reward(bool(block), cell not in self.visited, k, u))
        self.visited.add(cell)
        self.t, self.cell, self.previous, self._answered = self.t + 1, cell, self.cell, False
        self.airspace.tracks.publish(self.t, cell)
        self.builder.cells.append(cell)
        self.builder.actions.append(self.action)
        self.builder.blocks.append(block)
        self.steps += 1
        self.phase = Phase.SENSE

    def _before_visit(self, k: int, cell: int) -> float:
        """Return r^u by the UAV's own map: the uncertainty of a cell at t + 1 just before the visit resets it."""
        if self.config.scenario == 1:
            return float(self.active[cell])
        return self.law.value(k, self.last_visit.item(k), self.t + 1, self._factor)
