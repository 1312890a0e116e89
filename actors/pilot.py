"""One UAV as a core without I/O: it senses, ships its record when due, decides, moves, and says what it must wait for.

Per tick t, in this order (docs/explanation/architecture.md): sense the peers near it and update the own map; at t mod
T_u = phase ship the record and merge the TMC's map; observe o(t) and choose a(t); move, unless the target is held; the
new cell is visited at t + 1.
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
"""Ticks that a pilot flies at most before it looks up."""


class LostRecordsError(Exception):
    """The TMC has lost what it had acknowledged; only a new process can take the flight up again."""


class Phase(Enum):
    """What the pilot does next, or waits for."""

    IDLE = "waits for an episode"
    POLICY = "waits for a policy"
    SENSE = "senses its peers"
    MAP = "waits for the TMC's map"
    ACT = "decides"
    MOVE = "moves"


@dataclass
class RecordBuilder:
    """What was flown since the last record."""

    first: int
    cells: list[int] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)
    blocks: list[int] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    seen: list[tuple[int, int]] = field(default_factory=list)
    values: list[float] = field(default_factory=list)


class Pilot:
    """UAV `uav` of a world. `make_controller` turns the bytes of a policy file into a Controller; a planner needs none.

    `clock`: the wall clock in ns that records are stamped with; 0 where there is none.
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
        """The policy, where each move is told with what it is worth (`replay.priority_exponent`)."""
        self.phase = Phase.IDLE
        self.episode = self.t = self.cell = self.previous = self.sequence = self.version = 0
        self.policy = self.wanted = 0
        self.explored = self.steps = 0
        self.pending: Record | None = None
        self.unacknowledged: list[Record] = []
        """Records that the TMC has not acknowledged as journalled for good."""

    # Messages in.

    def begin(self, begin: Begin) -> PolicyRequest | None:
        """Start an episode, or, in a new process, take a flight up again where the TMC's last record of it ends."""
        if begin.episode <= self.episode:
            return None  # a repeat
        track = begin.track.tolist()
        self.episode, self.t, self.cell, self.previous = begin.episode, begin.tick, track[-1], track[-2:][0]
        self.sequence, self.version = begin.sequence, begin.version
        self.unacknowledged = [r for r in self.unacknowledged if r.sequence < begin.sequence]
        self.airspace.begin(self.episode, self.world.starts(self.episode))
        for uav in begin.lost.tolist():
            self.airspace.lose(uav)
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
        for tick, cell in enumerate(track):  # a process that was started again says again where it was
            self.airspace.tracks.publish(tick, cell)
        return self._want(begin.policy, Phase.SENSE)

    def on_map(self, answer: Map) -> PolicyRequest | None:
        """The TMC's answer to the record of tick t; anything else is old news and dropped."""
        self.acknowledge(answer.acknowledged)
        if (answer.episode, answer.tick) != (self.episode, self.t) or self.t > self.shipped or self._answered:
            return None
        if self.config.scenario == 1:
            self.active[:] = False
            self.active[answer.active] = True
        else:
            self.last_visit = merge(self.last_visit, answer.last_visit)
        self.version, self.pending, self._answered = answer.version, None, True
        # A flight taken up again is answered before it has sensed its peers anew.
        return self._want(answer.policy, Phase.ACT if self.phase is Phase.MAP else Phase.SENSE)

    def acknowledge(self, sequence: int) -> list[Record]:
        """The TMC has the records below `sequence` for good; returns those of them that were still in the
        unacknowledged.
        """
        done = [r for r in self.unacknowledged if r.sequence < sequence]
        self.unacknowledged = self.unacknowledged[len(done) :]
        return done

    def records_from(self, sequence: int) -> list[Record]:
        """What to send again to a TMC whose next record of this UAV is `sequence`. Raises LostRecordsError."""
        again = [r for r in self.unacknowledged if r.sequence >= sequence]
        if len(again) < self.sequence - sequence:
            raise LostRecordsError(f"the TMC asks for record {sequence}, which it had acknowledged")
        return again

    def _want(self, version: int, then: Phase) -> PolicyRequest | None:
        """A policy reaches a UAV only at an exchange: ask for the one that the TMC names, if it is another."""
        self.phase = then
        if self._planner is not None or version == self.policy:
            return None
        self.phase, self._then, self.wanted = Phase.POLICY, then, version
        return PolicyRequest(version)

    def on_lost(self, lost: Lost) -> None:
        """The team goes on without a UAV."""
        if lost.episode == self.episode:
            self.airspace.lose(lost.uav)

    def on_policy(self, policy: Policy) -> None:
        """The policy that was asked for. Raises PolicyError when it cannot fly here."""
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
        """Fly until a record must go out (returned), or a message is needed (None); raises Waiting for a peer.

        Also returns after some ticks without either, so that whoever calls can listen and be heard (`under_way`).
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
        """True while nothing is needed to go on but another call of `advance`."""
        return self.phase in (Phase.SENSE, Phase.ACT, Phase.MOVE)

    def _sense(self) -> bool:
        """Sense at t and make the local update (Sec. II-D): own cell and cells of sensed peers get tau = t.

        Returns whether a record must go out now.
        """
        if self.shipped == self.t == self.config.training.ticks:
            self.phase = Phase.IDLE  # taken up at the episode's end, which its peers may have left behind
            return False
        self.peers = self.airspace.sense(self.t, self.cell)
        index = self.law.index_list
        for cell in (self.cell, *self.peers):
            if index[cell] >= 0:
                self.last_visit[index[cell]] = self.t
        due, fresh = self.config.due(self.uav, self.t), self.t > self.shipped
        if fresh:  # a flight taken up again stands at a tick that the TMC has
            self.builder.seen.extend((self.t, cell) for cell in self.peers)
        self.phase = Phase.MAP if due and not self._answered else Phase.ACT
        return due and fresh

    def _ship(self) -> Record:
        leg = self.builder
        seen = np.array(leg.seen, "<u2").reshape(-1, 2) if leg.seen else None
        self.pending = Record(
            self.uav, self.incarnation, self.sequence, self.episode, leg.first, self.t, self.version, self.policy,
            np.array(leg.cells, "<u2"), np.array(leg.actions, "u1"), np.array(leg.blocks, "u1"),
            np.array(leg.rewards, "<f4"),
            EMPTY if seen is None else seen[:, 0].copy(), EMPTY if seen is None else seen[:, 1].copy(),
            np.array(leg.values, "<f4") if leg.values else NONE,
            self._clock(),
        )  # fmt: skip
        self.unacknowledged.append(self.pending)
        self.sequence += 1
        self.shipped = self.t
        self.builder = RecordBuilder(self.t + 1)
        return self.pending

    def map_of(self, t: int) -> NDArray[np.float64]:
        """The UAV's own uncertainty map U_i(t), shape (R,)."""
        if self.config.scenario == 1:
            return self.active[self.law.cells].astype(np.float64)
        return self.law.values(self.last_visit, t, self._factor)

    def state(self) -> LocalState:
        """What this UAV knows at t."""
        allowed = self.observer.allowed(self.cell, self.peers)
        draw = self._draws[self.t][1]
        return LocalState(self.t, self.cell, self.previous, self.peers, self.map_of(self.t), allowed, draw)

    def _act(self) -> None:
        """Choose a(t), epsilon-greedy; at the end of the episode there is nothing left to do."""
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
        """Choose by the draws of the tick: the action, and what it is worth where records tell so."""
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
        cell, block = self.world.moves[self.cell][self.action]
        if not block and self.airspace.held(self.t, self.cell, cell):
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
        """r^u by the UAV's own map: the uncertainty at t + 1 just before the visit resets it."""
        if self.config.scenario == 1:
            return float(self.active[cell])
        return self.law.value(k, self.last_visit.item(k), self.t + 1, self._factor)
