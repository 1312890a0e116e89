"""One episode as the TMC sees it: records in, map answers out, and the truth, tick by tick, once all have reported.

Two clocks run here. The *exchange* clock visits the ticks at which somebody is due, in order: an exchange is answered
when every record due by then is in, so the answer does not depend on who was faster. The *truth* clock follows the
slowest UAV: only when all have reported a tick are its visits, rewards and uncertainty final and given to the replay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.grid import OFF_GRID, STAY
from tmc.kernel.reward import Block, RewardLaw
from tmc.kernel.uncertainty import merge, step_events
from tmc.kernel.world import World
from tmc.replay import Replay
from tmc.wire.messages import EMPTY, Begin, Map, Record

GONE = 65_535
"""Stands for the cell of a UAV that was lost, in the ticks after its last record."""


class RefusedError(ValueError):
    """A record that cannot be true; nothing was changed by it."""


@dataclass(frozen=True)
class Truth:
    """What became final, one entry a tick from `first` on: sum_k u_k, the rewards (N,), and the events (tick, cell)."""

    first: int
    uncertainty: list[float]
    reward: list[NDArray[np.float32]]
    events: list[tuple[int, int]]


@dataclass(frozen=True)
class Exchange:
    """The exchange at `tick`: the UAVs that are answered, and the map that they get, as it was at that tick.

    `last_visit` (R,) u16 in scenario II, `active` u16 cells in scenario I; `believed`: its uncertainty, summed.
    """

    tick: int
    version: int
    uavs: list[int]
    believed: float
    last_visit: NDArray[np.uint16]
    active: NDArray[np.uint16]


class Flight:
    """The state of one episode. `version` numbers the maps of the whole mission, on from episode to episode."""

    def __init__(self, world: World, reward: RewardLaw, replay: Replay, episode: int, version: int) -> None:
        config = world.config
        self.world, self.reward, self.replay, self.episode = world, reward, replay, episode
        self.T, self.N = config.training.ticks, config.team.size
        self.scenario = config.scenario
        self.starts = world.starts(episode)
        self.factor = world.initial_factor(episode)
        K, R = world.grid.size, world.law.cells.size
        self.cells = np.zeros((self.T + 1, self.N), "<u2")
        self.actions = np.zeros((self.T + 1, self.N), "u1")
        self.blocks = np.zeros((self.T + 1, self.N), "u1")
        self.own_rewards = np.zeros((self.T + 1, self.N), "<f4")
        self.base = np.zeros((self.T + 1, self.N), np.int64)
        self.reported = [-1] * self.N
        self.lost: dict[int, int] = {}
        """Lost UAVs, and the tick of their last record."""
        self.cells[0] = self.starts
        # The exchange clock: what the TMC believes, and what it knows each UAV to believe.
        self.version = version
        self.next_exchange = 0
        self.believed = np.zeros(R, "<u2")
        self.beliefs = np.zeros((self.N, R), "<u2")
        # The truth clock: final up to `done`.
        self.done = -1
        self.last_visit = np.zeros(R, "<u2")
        self.active = np.zeros(K, bool)
        self.visited = np.zeros((self.N, K), bool)
        self.visited_by_team = np.zeros(K, bool)
        self.total_uncertainty = 0.0
        self.total_reward = np.zeros(self.N)
        self.blocked = dict.fromkeys((Block.GRID, Block.OBSTACLE, Block.UAV), 0)
        self._fresh = Truth(0, [], [], [])
        self.base[:] = replay.add_frame(0, np.zeros(R, "u2"))

    @property
    def over(self) -> bool:
        """All ticks are final and answered, or nobody is left to fly them."""
        return self.done == self.T and (self.next_exchange > self.T or len(self.lost) == self.N)

    def accept(self, record: Record) -> None:
        """Take a UAV's next record; raises RefusedError when it does not follow from what is known."""
        i, first, last = record.uav, record.first, record.tick
        self._check(record)
        moves = slice(max(first, 1), last + 1)
        self.cells[first : last + 1, i] = record.cells
        self.actions[moves, i] = record.actions
        self.blocks[moves, i] = record.blocks
        self.own_rewards[moves, i] = record.rewards
        self.reported[i] = last
        seen = [*zip(range(first, last + 1), record.cells.tolist(), strict=True)]
        seen += zip(record.seen_tick.tolist(), record.seen_cell.tolist(), strict=True)
        for tick, cell in seen:
            k = self.world.law.index_list[cell]
            if k >= 0:
                self.beliefs[i, k] = max(self.beliefs[i, k], tick)

    def _check(self, r: Record) -> None:
        if r.uav in self.lost:
            raise RefusedError(f"UAV {r.uav} was declared lost in this episode")
        if r.first != self.reported[r.uav] + 1:
            raise RefusedError(f"record of UAV {r.uav} starts at tick {r.first}, expected {self.reported[r.uav] + 1}")
        due = (
            next(t for t in range(r.first, self.T + 1) if self.world.config.due(r.uav, t)) if r.first <= self.T else -1
        )
        if r.tick != due:
            raise RefusedError(f"record of UAV {r.uav} ends at tick {r.tick}, it is due at {due}")
        moves = r.tick - max(r.first, 1) + 1
        if not (r.cells.size == r.tick - r.first + 1 and r.actions.size == r.blocks.size == r.rewards.size == moves):
            raise RefusedError(f"record of UAV {r.uav} has arrays that do not match its ticks {r.first}..{r.tick}")
        self._check_path(r)
        seen = r.seen_tick
        if seen.size != r.seen_cell.size or (seen.size and not (r.first <= seen.min() and seen.max() <= r.tick)):
            raise RefusedError(f"record of UAV {r.uav} has sightings outside its ticks")
        if r.seen_cell.size and r.seen_cell.max() >= self.world.grid.size:
            raise RefusedError(f"record of UAV {r.uav} has a sighting off the grid")

    def _check_path(self, r: Record) -> None:
        """Every cell follows from the one before by the action, or is the same where the move was blocked."""
        if r.cells.max() >= self.world.grid.size or self.world.map.blocked[r.cells].any():
            raise RefusedError(f"record of UAV {r.uav} has a cell off the grid or on an obstacle")
        if r.first == 0 and int(r.cells[0]) != self.starts[r.uav]:
            raise RefusedError(f"UAV {r.uav} did not start on cell {self.starts[r.uav]}")
        if r.actions.size and (r.actions.max() > 8 or r.blocks.max() > max(Block)):
            raise RefusedError(f"record of UAV {r.uav} has an unknown action or block")
        before = r.cells[:-1] if r.first == 0 else np.append(self.cells[r.first - 1, r.uav], r.cells[:-1])
        after = r.cells[1:] if r.first == 0 else r.cells
        targets = self.world.grid.targets[before, r.actions]
        if (np.where(r.blocks == Block.NONE, targets, before) != after).any():
            raise RefusedError(f"record of UAV {r.uav} jumps: a cell does not follow from the action before it")
        if (self._static_block(targets) != np.where(r.blocks == Block.UAV, 0, r.blocks)).any():
            raise RefusedError(f"record of UAV {r.uav} says that a move was blocked by what is not there")
        if (r.actions[r.blocks == Block.UAV] == STAY).any():
            raise RefusedError(f"record of UAV {r.uav} says that another UAV kept it from staying where it is")

    def _static_block(self, targets: NDArray[np.int32]) -> NDArray[np.int64]:
        """What the map says of moves: Block.GRID, Block.OBSTACLE or 0."""
        obstacle = np.where(self.world.map.blocked[np.maximum(targets, 0)], int(Block.OBSTACLE), 0)
        return np.where(targets == OFF_GRID, int(Block.GRID), obstacle)

    def exchanges(self) -> list[Exchange]:
        """Run the exchange clock as far as the records allow; one entry for each that could be held."""
        done = []
        while self.next_exchange <= self.T:
            t = self.next_exchange
            due = [i for i in range(self.N) if i not in self.lost and self.world.config.due(i, t)]
            if any(self.reported[i] < t for i in due):
                break
            if due:
                done.append(self._exchange(t, due))
            self.next_exchange += 1
        return done

    def _exchange(self, t: int, due: list[int]) -> Exchange:
        self.version += 1
        if self.scenario == 1:
            self._settle(t)
            frame = self.replay.add_frame(t, self.active[self.world.law.cells])
            self.base[t:, :] = frame
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
            self.base[t:, i] = numbers[key]
        believed = float(self.uncertainty(self.believed, t).sum())
        return Exchange(t, self.version, due, believed, self.believed.copy(), EMPTY)

    def _apply_visits(self, i: int, t: int) -> None:
        """UAV i's visits up to t, all reported by now, into the map that the TMC believes."""
        for tick in range(max(t - self.world.config.T_u, 0), t + 1):
            k = self.world.law.index_list[self.cells[tick, i]]
            if k >= 0:
                self.believed[k] = max(self.believed[k], tick)

    def answer(self, exchange: Exchange, policy: int, sequence: int) -> Map:
        """The TMC's answer at an exchange; `sequence`: the record that it answers."""
        last_visit, active = exchange.last_visit, exchange.active
        return Map(self.episode, exchange.tick, exchange.version, policy, sequence, last_visit, active)

    def begin(self, i: int, policy: int, sequence: int) -> Begin:
        """Fly from the last record that the TMC has of UAV i; at the start of the episode, from its beginning."""
        shipped, lost = self.reported[i], np.array([*self.lost], "<u2")
        tick = max(shipped, 0)
        belief, track = self.beliefs[i].copy(), self.cells[: tick + 1, i].copy()
        return Begin(self.episode, tick, shipped, sequence, self.version, policy, belief, track, lost)

    def uncertainty(self, last_visit: NDArray[np.uint16], t: int) -> NDArray[np.float64]:
        """u_k(t) over the monitored cells, scenario II."""
        return self.world.law.values(last_visit, t, self.factor)

    def settle(self) -> Truth:
        """Run the truth clock up to the slowest UAV; returns what became final since the last call."""
        self._settle(min((t for i, t in enumerate(self.reported) if i not in self.lost), default=self.T))
        truth, self._fresh = self._fresh, Truth(self.done + 1, [], [], [])
        for t, reward in enumerate(truth.reward, truth.first):
            # A lost UAV may have been seen until its next exchange, and that seeing remembered until the one after it.
            sure = not any(last < t <= last + 2 * self.world.config.T_u for last in self.lost.values())
            self.replay.add_row(self.episode, t, self.cells[t], self.actions[t], reward, self.base[t], sure=sure)
        return truth

    def lose(self, uav: int) -> int:
        """Go on without a UAV: its visits count up to its last record, the tick of which is returned."""
        last = self.lost[uav] = self.reported[uav]
        self.cells[last + 1 :, uav] = GONE
        return last

    def present(self, t: int) -> list[tuple[int, int]]:
        """(uav, cell) of those who were not lost at tick t."""
        return [(i, cell) for i, cell in enumerate(self.cells[t].tolist()) if cell != GONE]

    def _settle(self, upto: int) -> None:
        while self.done < upto:
            t = self.done = self.done + 1
            reward = self._visit(t)
            self._fresh.reward.append(reward.astype("<f4"))
            self._fresh.uncertainty.append(self._true_uncertainty(t))
            if t:
                self.total_uncertainty += self._fresh.uncertainty[-1]
                self.total_reward += reward
                for block in self.blocks[t][self.blocks[t] > 0].tolist():
                    self.blocked[Block(block)] += 1

    def _visit(self, t: int) -> NDArray[np.float64]:
        """Rewards of all UAVs at tick t (Sec. III-B), shape (N,), then the visits of that tick."""
        index, reward = self.world.law.index_list, np.zeros(self.N)
        for i, cell in self.present(t):
            k = index[cell]
            if t:
                reward[i] = self._reward(t, i, cell, k)
            self.visited[i, cell] = True
            self.visited_by_team[cell] = True
            if k >= 0:
                self.last_visit[k] = t
        return reward

    def _reward(self, t: int, i: int, cell: int, k: int) -> float:
        """By the true map, or as the UAV reckoned it; with novelty for the UAV, or for the team."""
        rules, novel = self.world.config.reward, not self.visited[i, cell]
        if self.blocks[t, i]:
            return rules.collision
        counted = novel if rules.novelty == "own" else not self.visited_by_team[cell]
        if rules.uncertainty == "own":
            return float(self.own_rewards[t, i]) + rules.new_cell * (counted - novel)
        return self.reward(False, counted, k, self._before_visit(k, cell, t))

    def _before_visit(self, k: int, cell: int, t: int) -> float:
        if k < 0:
            return 0.0
        if self.scenario == 1:
            return float(self.active[cell])
        return self.world.law.value(k, int(self.last_visit[k]), t, self.factor)

    def _true_uncertainty(self, t: int) -> float:
        """sum_k u_k(t), the inner sum of eq. (6); in scenario I it also lets the events of the slot in."""
        if self.scenario == 2:
            return float(self.uncertainty(self.last_visit, t).sum())
        if t:
            arrivals = self.world.arrivals(self.episode, t)
            self.active, new = step_events(self.active, [cell for _, cell in self.present(t)], arrivals)
            self._fresh.events.extend((t, int(k)) for k in new)
        return float(self.active.sum())
