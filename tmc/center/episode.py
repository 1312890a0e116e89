"""One episode as the TMC sees it: flight records in, map answers out, and final ticks once all UAVs have reported.

Two ticks advance here. The *exchange tick* visits the ticks at which a UAV is due, in order. An exchange is answered
when every record due by then is in, so the answer does not depend on which UAV was faster. The *final tick* follows the
slowest UAV. Once all UAVs have reported a tick, its visits, rewards and uncertainty are final and go to the replay.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmc.center.priorities import first_errors
from tmc.center.replay import Replay
from tmc.kernel.grid import STAY
from tmc.kernel.reward import Block, RewardLaw
from tmc.kernel.uncertainty import merge, step_events
from tmc.kernel.world import World
from tmc.wire.messages import EMPTY, Begin, Map, Record

NO_CELL = 65_535
"""The cell of a UAV that was lost, in the ticks after its last record."""
MAX_TICKS_AT_ONCE = 64
"""Ticks that are computed at once, at most."""
_UAV = int(Block.UAV)


class RefusedError(ValueError):
    """A record cannot be true. It has changed nothing."""


@dataclass(frozen=True)
class FinalTicks:
    """Hold what became final, with one entry per tick from `first` on.

    `uncertainty`: sum_k u_k; `present`: number of UAVs; `reward`: mean of their rewards; `events`: (tick, cell) pairs.
    """

    first: int
    uncertainty: list[float]
    present: list[int]
    reward: list[float]
    events: list[tuple[int, int]]


@dataclass(frozen=True)
class Exchange:
    """Hold the exchange at `tick`: the UAVs that are answered, and the map that they get, as it was at that tick.

    `last_visit` (R,) u16 in scenario II, `active` u16 cells in scenario I; `believed`: its uncertainty, summed.
    """

    tick: int
    version: int
    uavs: list[int]
    believed: float
    last_visit: NDArray[np.uint16]
    active: NDArray[np.uint16]


class EpisodeState:
    """Hold the state of one episode. `version` numbers the maps of the whole mission, across episodes."""

    def __init__(self, world: World, reward: RewardLaw, replay: Replay, number: int, version: int) -> None:
        config = world.config
        self.world, self.reward, self.replay, self.number = world, reward, replay, number
        self._rules = config.reward
        self.T, self.N = config.training.ticks, config.team.size
        self.scenario = config.scenario
        self.starts = world.starts(number)
        self.factor = world.initial_factor(number)
        self._due = [[i for i in range(self.N) if config.phase(i) == p] for p in range(config.T_u)]
        K, R = world.grid.size, world.law.cells.size
        self.cells = np.zeros((self.T + 1, self.N), "<u2")
        self.actions = np.zeros((self.T + 1, self.N), "u1")
        self.blocks = np.zeros((self.T + 1, self.N), "u1")
        self.own_rewards = np.zeros((self.T + 1, self.N), "<f4")
        self.base = np.zeros((self.T + 1, self.N), np.int64)
        self._values = np.full((self.T + 1, self.N, 2), np.nan, "<f4") if config.replay.priority_exponent else None
        """Q(o_t, a_t) and max_a Q(o_t, a), by the tick t of the decision, as the UAVs computed them."""
        self._prioritised = 0
        self.reported = [-1] * self.N
        self.lost: dict[int, int] = {}
        """Lost UAVs, and the tick of their last record."""
        self.cells[0] = self.starts
        # Up to the exchange tick: what the TMC believes, and what it knows each UAV to believe.
        self.version = version
        self.next_exchange = 0
        self.believed = np.zeros(R, "<u2")
        self.beliefs = np.zeros((self.N, R), "<u2")
        self.given = [version] * self.N  # the map that each UAV was answered with last
        # The final tick is `done`.
        self.done = -1
        self.last_visit = np.zeros(R, "<u2")
        self.active = np.zeros(K, bool)
        self.visited: list[set[int]] = [set() for _ in range(self.N)]
        self.visited_by_team: set[int] = set()
        self.total_uncertainty = 0.0
        self.rewards = np.zeros((self.T + 1, self.N), "<f4")
        self.total_reward = [0.0] * self.N
        self.blocked = dict.fromkeys((Block.GRID, Block.OBSTACLE, Block.UAV), 0)
        self._fresh = FinalTicks(0, [], [], [], [])
        self.base[:] = replay.add_frame(0, np.zeros(R, "u2"))

    @property
    def over(self) -> bool:
        """Return True when all ticks are final and answered, or no UAV is left to fly them."""
        return self.done == self.T and (self.next_exchange > self.T or len(self.lost) == self.N)

    def accept(self, record: Record) -> None:
        """Accept a UAV's next record. Raises RefusedError if it does not follow from what is known."""
        i, first, last = record.uav, record.first, record.tick
        self._check(record)
        moves = slice(max(first, 1), last + 1)
        self.cells[first : last + 1, i] = record.cells
        self.actions[moves, i] = record.actions
        self.blocks[moves, i] = record.blocks
        self.own_rewards[moves, i] = record.rewards
        if self._values is not None and record.values.size:
            self._values[moves.start - 1 : last, i] = record.values.reshape(-1, 2)
        self.reported[i] = last
        index, belief = self.world.law.index_list, self.beliefs[i]
        for tick, cell in enumerate(record.cells.tolist(), first):
            if index[cell] >= 0:
                belief[index[cell]] = tick  # the newest: a UAV's own visits come in their order
        for tick, cell in zip(record.seen_tick.tolist(), record.seen_cell.tolist(), strict=True):
            k = index[cell]
            if k >= 0 and belief[k] < tick:
                belief[k] = tick

    def _check(self, r: Record) -> None:
        if r.uav in self.lost:
            raise RefusedError(f"UAV {r.uav} was declared lost in this episode")
        if r.first != self.reported[r.uav] + 1:
            raise RefusedError(f"record of UAV {r.uav} starts at tick {r.first}, expected {self.reported[r.uav] + 1}")
        due = self.world.config.next_due(r.uav, r.first) if r.first <= self.T else -1
        if r.tick != due:
            raise RefusedError(f"record of UAV {r.uav} ends at tick {r.tick}, it is due at {due}")
        moves = r.tick - max(r.first, 1) + 1
        if not (r.cells.size == r.tick - r.first + 1 and r.actions.size == r.blocks.size == r.rewards.size == moves):
            raise RefusedError(f"record of UAV {r.uav} has arrays that do not match its ticks {r.first}..{r.tick}")
        valued = self._values is not None and self.world.config.team.controller == "policy"
        if r.values.size != (2 * moves if valued else 0):
            raise RefusedError(f"record of UAV {r.uav} has {r.values.size} values of {moves} moves: two each, or none")
        self._check_path(r)
        ticks, cells = r.seen_tick.tolist(), r.seen_cell.tolist()
        if len(ticks) != len(cells) or any(not r.first <= t <= r.tick for t in ticks):
            raise RefusedError(f"record of UAV {r.uav} has sightings outside its ticks")
        if any(cell >= self.world.grid.size for cell in cells):
            raise RefusedError(f"record of UAV {r.uav} has a sighting off the grid")

    def _check_path(self, r: Record) -> None:
        """Check that every cell follows from the one before by its action, or is the same if the move was blocked.

        Uses plain lists: a record has some ten moves, for which NumPy's calls cost several times as much.
        """
        cells, moves = r.cells.tolist(), self.world.moves
        if r.first == 0 and cells[0] != self.starts[r.uav]:
            raise RefusedError(f"UAV {r.uav} did not start on cell {self.starts[r.uav]}")
        here = cells.pop(0) if r.first == 0 else int(self.cells[r.first - 1, r.uav])
        for action, block, cell in zip(r.actions.tolist(), r.blocks.tolist(), cells, strict=True):
            if action > STAY or block > _UAV:
                raise RefusedError(f"record of UAV {r.uav} has an unknown action or block")
            after, static = moves[here][action]
            if cell != (here if block else after) or static != (0 if block == _UAV else block):
                raise RefusedError(f"record of UAV {r.uav} {self._why_not(cell, here if block else after, block)}")
            if block == _UAV and action == STAY:
                raise RefusedError(f"record of UAV {r.uav} says that another UAV kept it from staying where it is")
            here = cell

    def _why_not(self, cell: int, due: int, block: int) -> str:
        """Return what is wrong with a move to `cell` that should have led to `due`."""
        if cell >= self.world.grid.size or self.world.map.blocked[cell]:
            return "has a cell off the grid or on an obstacle"
        if cell != due or not block:
            return "jumps: a cell does not follow from the action before it"
        return "says that a move was blocked by what is not there"

    def exchanges(self) -> list[Exchange]:
        """Hold all exchanges that the records allow, and return them."""
        done = []
        while self.next_exchange <= self.T:
            t = self.next_exchange
            due = self.due(t)
            if any(self.reported[i] < t for i in due):
                break
            if due:
                done.append(self._exchange(t, due))
                for i in due:
                    self.given[i] = self.version
            self.next_exchange += 1
        return done

    def due(self, t: int) -> list[int]:
        """Return the UAVs that ship a record at tick t."""
        due = range(self.N) if t == self.T else self._due[t % self.world.config.T_u]
        return [i for i in due if i not in self.lost]

    def _exchange(self, t: int, due: list[int]) -> Exchange:
        self.version += 1
        if self.scenario == 1:
            self._finalise(t)
            self.base[t : t + 2] = self.replay.add_frame(t, self.active[self.world.law.cells])
            active = np.flatnonzero(self.active).astype("<u2")
            return Exchange(t, self.version, due, float(active.size), EMPTY, active)
        for i in due:
            self._apply_visits(i, t)
        numbers: dict[bytes, int] = {}
        for i in due:
            self.beliefs[i] = merge(self.beliefs[i], self.believed)
            key = self.beliefs[i].tobytes()  # UAVs that believe the same share one frame
            if key not in numbers:
                numbers[key] = self.replay.add_frame(t, self.beliefs[i])
            self.base[t : t + self.world.config.T_u + 1, i] = numbers[key]  # until the next exchange
        believed = float(self.uncertainty(self.believed, t).sum())
        return Exchange(t, self.version, due, believed, self.believed.copy(), EMPTY)

    def _apply_visits(self, i: int, t: int) -> None:
        """Enter UAV i's visits up to t, all reported by now, into the map that the TMC believes."""
        index, believed, first = self.world.law.index_list, self.believed, max(t - self.world.config.T_u, 0)
        for tick, cell in enumerate(self.cells[first : t + 1, i].tolist(), first):
            k = index[cell]
            if k >= 0 and believed[k] < tick:
                believed[k] = tick

    def answer(self, exchange: Exchange, policy: int, sequence: int, acknowledged: int) -> Map:
        """Return the answer to record `sequence` at an exchange; records below `acknowledged` are committed."""
        last_visit, active = exchange.last_visit, exchange.active
        return Map(
            episode=self.number, tick=exchange.tick, version=exchange.version, policy=policy, sequence=sequence,
            acknowledged=acknowledged, last_visit=last_visit, active=active,
        )  # fmt: skip

    def begin(self, i: int, policy: int, sequence: int) -> Begin:
        """Return the order to fly on from UAV i's last record, or from the episode's beginning if there is none."""
        shipped, lost, tick = self.reported[i], np.array([*self.lost], "<u2"), max(self.reported[i], 0)
        belief, track = self.beliefs[i].copy(), self.cells[: tick + 1, i].copy()
        return Begin(
            episode=self.number, tick=tick, shipped=shipped, sequence=sequence, version=self.given[i], policy=policy,
            last_visit=belief, track=track, lost=lost,
        )  # fmt: skip

    def uncertainty(self, last_visit: NDArray[np.uint16], t: int | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return u_k(t) of the monitored cells in scenario II; shapes as in `UncertaintyLaw.values`."""
        return self.world.law.values(last_visit, t, self.factor)

    def finalise(self) -> FinalTicks:
        """Advance the final tick to the slowest UAV's; return what became final since the last call."""
        self._finalise(min((t for i, t in enumerate(self.reported) if i not in self.lost), default=self.T))
        final, self._fresh = self._fresh, FinalTicks(self.done + 1, [], [], [], [])
        ticks = slice(final.first, self.done + 1)
        if final.uncertainty:
            sure = [self._sure(t) for t in range(final.first, self.done + 1)]
            rows = (self.cells[ticks], self.actions[ticks], self.rewards[ticks], self.base[ticks])
            self.replay.add_rows(self.number, final.first, *rows, sure)
            if self._values is not None:
                self._set_initial_priorities(self._values)
        return final

    def _set_initial_priorities(self, values: NDArray[np.float32]) -> None:
        """Set the first priorities (Horgan et al. 2018, Sec. 3) of transitions whose values are final by now.

        A transition from t needs max_a Q(o_{t+1}, a), which comes with the move from t + 1: the last one of an episode
        has none. With n-step sums the 1-step error stands for that of the whole transition.
        """
        dqn, first = self.world.config.dqn, self._prioritised
        self._prioritised = self.T - 1 if self.done == self.T else max(self.done + 1 - max(2, dqn.n_step), first)
        ticks, following = slice(first, self._prioritised), slice(first + 1, self._prioritised + 1)
        errors = first_errors(dqn.reward_scale * self.rewards[following], values[ticks], dqn.gamma, values[following])
        self.replay.set_initial_errors(self.replay.rows_in - 1 - self.done + first, errors)

    def _sure(self, t: int) -> bool:
        """Return False for the ticks at which a peer may have sensed a lost UAV without a record of it.

        It may have been sensed until its next exchange, and the peer may have remembered that until the exchange after.
        Also False if no UAV is left.
        """
        lost, long = self.lost.values(), 2 * self.world.config.T_u
        return bool(self.present(t)) and not any(last < t <= last + long for last in lost)

    def lose(self, uav: int) -> int:
        """Go on without a UAV, whose visits count up to its last record; return the tick of that record."""
        last = self.lost[uav] = self.reported[uav]
        self.cells[last + 1 :, uav] = NO_CELL
        return last

    def digest(self) -> str:
        """Return the BLAKE2b digest (hex) of the true map, the one that the TMC believes, and the UAVs' beliefs."""
        maps = (self.last_visit, self.active, self.believed, self.beliefs)
        return hashlib.blake2b(b"".join(a.tobytes() for a in maps), digest_size=16).hexdigest()

    def present(self, t: int) -> list[tuple[int, int]]:
        """Return (uav, cell) of the UAVs that were not lost at tick t."""
        return [(i, cell) for i, cell in enumerate(self.cells[t].tolist()) if cell != NO_CELL]

    def _finalise(self, upto: int) -> None:
        while self.done < upto:
            self._finalise_ticks(range(self.done + 1, min(self.done + MAX_TICKS_AT_ONCE, upto) + 1))

    def _finalise_ticks(self, ticks: range) -> None:
        """Make these ticks final; the map's uncertainty is computed for all of them at once."""
        fresh, maps = self._fresh, np.empty((len(ticks), self.last_visit.size), "<u2")
        sums = []
        for t in ticks:
            present = self.present(t)
            rewards = self._visit(t, present)
            fresh.present.append(len(present))
            fresh.reward.append(sum(rewards) / max(len(present), 1))
            if self.scenario == 1:
                sums.append(self._events(t, present))
            maps[t - ticks[0]] = self.last_visit
        self.done = ticks[-1]
        if self.scenario == 2:
            sums = self.uncertainty(maps, np.array(ticks)[:, None]).sum(axis=1).tolist()
        fresh.uncertainty.extend(sums)
        for u in sums[1:] if ticks[0] == 0 else sums:  # one by one: the same bits, however many come at once
            self.total_uncertainty += u

    def _visit(self, t: int, present: list[tuple[int, int]]) -> list[float]:
        """Return the rewards of the present UAVs at tick t (Sec. III-B), then enter the visits of that tick."""
        index, blocks, last_visit, rewards = self.world.law.index_list, self.blocks[t].tolist(), self.last_visit, []
        for i, cell in present:
            k, visited = index[cell], self.visited[i]
            if t:
                reward = self._reward(t, i, cell, k, blocks[i])
                self.total_reward[i] += reward
                rewards.append(reward)
                if blocks[i]:
                    self.blocked[Block(blocks[i])] += 1
            visited.add(cell)
            self.visited_by_team.add(cell)
            if k >= 0:
                last_visit[k] = t
        if t:
            self.rewards[t, [i for i, _ in present]] = rewards
        return rewards

    def _reward(self, t: int, i: int, cell: int, k: int, block: int) -> float:
        """Return the reward by the true map, or as the UAV computed it; with novelty for the UAV or for the team."""
        if block:
            return self._rules.collision
        novel = cell not in self.visited[i]
        counted = novel if self._rules.novelty == "own" else cell not in self.visited_by_team
        if self._rules.uncertainty == "own":
            return float(self.own_rewards[t, i]) + self._rules.new_cell * (counted - novel)
        if k < 0:
            return self.reward(False, counted, k, 0.0)
        if self.scenario == 1:
            return self.reward(False, counted, k, float(self.active[cell]))
        return self.reward(False, counted, k, self.world.law.value(k, self.last_visit.item(k), t, self.factor))

    def _events(self, t: int, present: list[tuple[int, int]]) -> float:
        """Clear the visited cells and add the events of the slot (scenario I); return sum_k e_k(t)."""
        if t:
            arrivals = self.world.arrivals(self.number, t)
            self.active, new = step_events(self.active, [cell for _, cell in present], arrivals)
            self._fresh.events.extend((t, int(k)) for k in new)
        return float(self.active.sum())
