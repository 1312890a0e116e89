"""The replay memory D: flight records in flat rings, and observations rebuilt from them on sampling (ADR 0002).

A row is one tick of the whole team: where each UAV stood, the action and reward that led there, and which map frame it
last got from the TMC. What UAV i believed at tick t follows: the frame, then the local updates of the ticks since
(Sec. II-D). A transition therefore takes some 24 bytes and its share of a frame, not two images.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmc.center.priorities import Priorities
from tmc.kernel.draws import Stream, uniforms
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.observation import Floats, Ints, ObservationBuilder, Views
from tmc.kernel.world import World


@dataclass(frozen=True)
class Sample:
    """Hold a minibatch; shapes as in `tmc.wire.messages.Minibatch`. `row`, `uav`: the place of each transition."""

    row: Ints
    uav: Ints
    index: Ints
    views: Views
    action: NDArray[np.uint8]
    reward: Floats
    discount: Floats
    allowed: NDArray[np.uint8]
    weight: Floats


class Ring:
    """Keep the newest `length` items, addressed by numbers that only grow."""

    def __init__(self, length: int, width: int, dtype: str) -> None:
        self.data = np.zeros((length, width) if width else length, dtype)

    def __setitem__(self, number: int | Ints, value: object) -> None:
        self.data[number % len(self.data)] = value

    def __getitem__(self, number: Ints) -> NDArray[Any]:
        return np.asarray(self.data[number % len(self.data)])

    def of(self, number: Ints, column: Ints) -> NDArray[Any]:
        """Return one entry per row. Shapes (B,)."""
        return np.asarray(self.data[number % len(self.data), column])


class Replay:
    """Hold the newest `replay.capacity` transitions of a mission; pure: rows in, minibatches out."""

    def __init__(self, world: World, observer: ObservationBuilder) -> None:
        config = world.config
        self.world, self.observer = world, observer
        self.n_step, self.gamma = config.dqn.n_step, config.dqn.gamma
        team, ticks = config.team.size, config.training.ticks
        self._starts_kept = max(1, config.replay.capacity // team)
        episodes = self._starts_kept // ticks + 2
        # Behind the oldest start, the rows since the last exchange are kept too: its local updates are in them.
        rows = self._starts_kept + self.n_step + config.T_u + episodes + 1
        R = world.law.cells.size
        self._events = config.scenario == 1
        frames = (rows // config.T_u + 4 * (episodes + 1)) * (1 if config.comms.phase == "together" else team)
        self.cells, self.actions = Ring(rows, team, "u2"), Ring(rows, team, "u1")
        self.rewards, self.base = Ring(rows, team, "f4"), Ring(rows, team, "i8")
        self.tick, self.episode = Ring(rows, 0, "u2"), Ring(rows, 0, "i8")
        self.frames = Ring(frames, (R + 7) // 8 if self._events else R, "u1" if self._events else "u2")
        self.frame_tick = Ring(frames, 0, "u2")
        self.starts, self.ends = Ring(self._starts_kept, 0, "i8"), Ring(self._starts_kept, 0, "i8")
        self.rows_in = self.frames_in = self.starts_in = self._sure_from = self._whole_from = 0
        self._factors: dict[int, NDArray[np.float64]] = {}
        self._nowhere = np.uint16(world.grid.size)
        self._column = np.append(np.where(world.law.index < 0, R, world.law.index), R).astype(np.int64)
        """The place of cell k among the monitored cells, R if it is not one of them. Shape (K + 1,)."""
        self.priorities: Priorities | None = None
        """By transition number, place * N + UAV; None if all are equally likely."""
        if config.replay.priority_exponent:
            self.priorities = Priorities(self._starts_kept * team, config.replay.priority_exponent)

    def __len__(self) -> int:
        """Return how many transitions can be drawn."""
        return (self.starts_in - self._oldest) * self.world.config.team.size

    @property
    def _oldest(self) -> int:
        """Return the oldest start of transitions that can be drawn."""
        return max(self.starts_in - self._starts_kept, self._whole_from)

    def _let_go(self) -> None:
        """Give up transitions of which rows or maps are overwritten.

        While all UAVs fly there are none: each row but an episode's last is a start, and the rings have room for these.
        Around the loss of a UAV there are rows that are part of no transition, and more maps.
        """
        row, frame = self.rows_in - len(self.tick.data), self.frames_in - len(self.frame_tick.data)
        if row <= 0 and frame <= 0:
            return
        first = place = self._oldest
        while place < self.starts_in and not self._is_whole(int(self.starts[np.array(place)]), row, frame):
            place += 1
        self._whole_from = place
        if self.priorities is not None and place > first:
            team = self.world.config.team.size
            self.priorities.drop(np.arange(first * team, place * team))

    def _is_whole(self, start: int, row: int, frame: int) -> bool:
        """Return True if the rows (from `row` on) and maps (from `frame` on) of the transitions at `start` are held."""
        at = np.array(start)
        maps = self.base[at][self._present(at)]
        # The local updates begin at the exchange before, at most T_u rows back.
        return start - self.world.config.T_u >= row and int(maps.min(initial=self.frames_in)) >= frame

    def add_frame(self, tick: int, frame: NDArray[np.generic]) -> int:
        """Keep a map as a UAV got it at `tick`, (R,) u16 last visits or bool e_k in scenario I; return its number."""
        self.frames[self.frames_in] = np.packbits(frame.astype(bool)) if self._events else frame
        self.frame_tick[self.frames_in] = tick
        self.frames_in += 1
        self._let_go()
        return self.frames_in - 1

    def add_rows(
        self,
        episode: int,
        first: int,
        cells: NDArray[np.uint16],
        actions: NDArray[np.uint8],
        rewards: Floats,
        base: Ints,
        sure: Sequence[bool],
    ) -> None:
        """Add ticks of `episode` from `first` on, in order from 0. Shapes (n, N): what led to a tick is in its row.

        A cell off the grid means that the UAV was lost. A row that is not `sure` is part of no transition.
        """
        row = self.rows_in
        rows = np.arange(row, row + len(cells))
        self.cells[rows], self.actions[rows], self.rewards[rows], self.base[rows] = cells, actions, rewards, base
        self.tick[rows], self.episode[rows] = np.arange(first, first + len(cells)), episode
        self.rows_in += len(cells)
        if first == 0:
            self._remember(episode)
        self._add_starts(row, first, sure)
        self._let_go()

    def _add_starts(self, row: int, first: int, sure: Sequence[bool]) -> None:
        """Add the transitions that end in the rows from `row` on; the first of these is of tick `first`."""
        starts, ends = [], []
        for number, known in enumerate(sure):
            end, tick = row + number, first + number
            self._sure_from = self._sure_from if known else end + 1
            last = tick == self.world.config.training.ticks  # a time limit cuts n-step sums short
            for back in range(min(self.n_step, tick), 0 if last else self.n_step - 1, -1):
                if end - back >= self._sure_from:
                    starts.append(end - back)
                    ends.append(end)
        place = np.arange(self.starts_in, self.starts_in + len(starts))
        self.starts[place], self.ends[place] = starts, ends
        self.starts_in += len(starts)
        if self.priorities is not None:
            self.priorities.add(self._present(np.array(ends, np.int64)).ravel())

    def set_initial_errors(self, row: int, errors: NDArray[np.float64]) -> None:
        """Set |TD error|, (n, N), of the transitions that start in the rows from `row` on; NaN: not known."""
        assert self.priorities is not None
        newest = min(self.starts_in, self._starts_kept, self.rows_in - row)  # every row has one start at most
        place = np.arange(self.starts_in - newest, self.starts_in)
        after = self.starts[place] - row
        meant = (after >= 0) & (after < len(errors))
        N = self.world.config.team.size
        numbers, found = place[meant][:, None] * N + np.arange(N), errors[after[meant]]
        known = ~np.isnan(found)
        self.priorities.set(numbers[known], found[known])

    def _present(self, row: Ints) -> NDArray[np.bool_]:
        """Return (B, N) bool: False for UAVs that were lost by then."""
        return np.asarray(self.cells[row] < self.world.grid.size)

    def _remember(self, episode: int) -> None:
        """Keep the initial map of an episode, and drop those of episodes of which no row is left."""
        factor = self.world.initial_factor(episode)
        if factor is not None:
            self._factors[episode] = factor
        oldest = int(self.episode[np.array(max(0, self.rows_in - len(self.tick.data)))])
        for gone in [e for e in self._factors if e < oldest]:
            del self._factors[gone]

    def digest(self) -> str:
        """Return the BLAKE2b digest (hex) of all drawable transitions and their maps, independent of their numbers."""
        place = np.arange(self._oldest, self.starts_in)
        held = place.size
        start, end = self.starts[place], self.ends[place]
        first = int(start[0]) if held else self.rows_in
        row = np.arange(first, self.rows_in)
        base = self.base[row]
        oldest = int(base.min()) if held else self.frames_in
        frame = np.arange(oldest, self.frames_in)
        parts = [start - first, end - first, base - oldest, self.frames[frame], self.frame_tick[frame]]
        parts += [ring[row] for ring in (self.cells, self.actions, self.rewards, self.tick, self.episode)]
        return hashlib.blake2b(b"".join(p.tobytes() for p in parts), digest_size=16).hexdigest()

    def sample(self, number: int, batch: int) -> Sample:
        """Draw minibatch `number`, which addresses the draws: uniform over all transitions, or by their priorities."""
        u = uniforms(self.world.config.training.seed, Stream.REPLAY, 2 * batch, tick=number)
        if self.priorities is not None and self.priorities.total > 0.0:
            index = self.priorities.draw(u[:batch])
            weight = self.priorities.weights(index, self.world.config.replay.importance_exponent)
            return self.rebuild(*np.divmod(index, self.world.config.team.size), weight)
        held = self.starts_in - self._oldest
        place = self._oldest + (u[:batch] * held).astype(np.int64)
        end = self.ends[place].astype(np.int64)
        present = self._present(end)
        uav = (u[batch:] * present.sum(axis=1)).astype(np.int64)
        if not present.all():
            order = np.argsort(~present, axis=1, kind="stable")  # UAVs that were not lost come first
            uav = order[np.arange(batch), uav]
        return self.rebuild(place, uav, np.zeros(0, np.float32))

    def rebuild(self, place: Ints, uav: Ints, weight: Floats) -> Sample:
        """Rebuild the transitions of UAVs `uav` at these starts. Shapes (B,); `weight` may be empty."""
        B, start, end = place.size, self.starts[place].astype(np.int64), self.ends[place].astype(np.int64)
        views = self.views(np.concatenate([start, end]), np.concatenate([uav, uav]))
        action = self.actions.of(start + 1, uav)
        reward, discount = np.zeros(B), np.ones(B)
        for k in range(1, self.n_step + 1):
            live = start + k <= end
            r = self.rewards.of(np.minimum(start + k, end), uav)
            reward += np.where(live, discount * r, 0.0)
            discount = np.where(live, discount * self.gamma, discount)
        index = place * self.world.config.team.size + uav
        return Sample(
            start, uav, index, views, action.astype(np.uint8), reward.astype(np.float32),
            discount.astype(np.float32), self.allowed(views.rows(slice(B, None))), weight,
        )  # fmt: skip

    def views(self, row: Ints, uav: Ints) -> Views:
        """Return what o_i at these rows is drawn from, exactly as the UAVs saw it. Shapes (B,)."""
        team = self._team(row)
        return self.observer.views(team[np.arange(row.size), uav], team, uav, self.belief(row, uav))

    def allowed(self, views: Views) -> NDArray[np.uint8]:
        """Return the actions that a UAV with these views would allow. Shape (B, 9)."""
        if not self.world.config.exploration.mask_blocked:
            return np.ones((views.cells.size, N_ACTIONS), np.uint8)
        return self.observer.allowed_batch(views)

    def _team(self, row: Ints) -> Ints:
        """Return the cells of the team at these rows, (B, N); K for a UAV that was lost."""
        return np.asarray(np.minimum(self.cells[row], self._nowhere), np.int64)

    def belief(self, row: Ints, uav: Ints) -> Floats:
        """Return U_i over the monitored cells, (B, R), as the observation has it."""
        base = self.base.of(row, uav)
        frame = self.frames[base]
        if self._events:
            bits = np.unpackbits(frame.astype(np.uint8), axis=1, count=self.world.law.cells.size)
            return bits.astype(np.float32)
        last_visit = self._local_updates(row, uav, frame, self.frame_tick[base].astype(np.int64))
        s = None
        if self.world.config.world.initial_map == "random":
            s = np.stack([self._factors[int(e)] for e in self.episode[row].tolist()])
        return self.world.law.singles(last_visit, self.tick[row].astype(np.int64)[:, None], s)

    def _local_updates(self, row: Ints, uav: Ints, last_visit: NDArray[np.uint16], since: Ints) -> NDArray[np.uint16]:
        """Apply in place the local updates (Sec. II-D) of every tick after `since`: own and sensed cells."""
        tick, R = self.tick[row].astype(np.int64), last_visit.shape[1]
        batch, back = _ages(tick - since)
        team, own = self._team(row[batch] - back), uav[batch]
        cells = team[np.arange(batch.size), own]
        known = self.observer.sensed(cells, team, own)
        known[np.arange(batch.size), own] = True
        column = self._column[team]
        known &= column < R
        at = np.nonzero(known)[0]
        where, seen = batch[at] * R + column[known], (tick[batch] - back)[at].astype(np.uint16)
        np.maximum.at(last_visit.ravel(), where, seen)  # flat: NumPy takes three times as long over rows
        return last_visit


def _ages(ticks: Ints) -> tuple[Ints, Ints]:
    """Return flat pairs (b, age) with ages ticks[b] - 1, ..., 1, 0 for each row b; none for negative counts."""
    count = np.maximum(ticks, 0)
    batch = np.repeat(np.arange(ticks.size), count)
    return batch, np.repeat(np.cumsum(count), count) - 1 - np.arange(batch.size)
