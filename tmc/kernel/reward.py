"""Compute the reward, eq. (13): r = r^c + r^n + lambda r^u; name the causes of a blocked move."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.config import Config


class Block(IntEnum):
    """Why a move was blocked. The UAV then stays, and gets r^c and no other reward at that tick."""

    NONE = 0
    GRID = 1
    OBSTACLE = 2
    UAV = 3


class RewardLaw:
    """Compute eq. (13) with the settings `reward.*`. `q`: exp(-alpha_k) of the monitored cells, shape (R,)."""

    def __init__(self, config: Config, q: NDArray[np.float64]) -> None:
        reward = config.reward
        self.collision = reward.collision
        self.new_cell = reward.new_cell
        # With uneven rates, a visit saves the team u_k / (1 - gamma q_k): the discounted sum of what it removes.
        scale = 1.0 / (1.0 - config.dqn.gamma * q) if reward.aligned else np.ones_like(q)
        self._weight = [float(w) for w in reward.weight * scale]

    def __call__(self, blocked: bool, novel: bool, index: int, u: float) -> float:
        """Return r_{t+1}. `index`: of the cell among the monitored ones, or -1; `u`: its u before the visit."""
        if blocked:
            return self.collision
        earned = self._weight[index] * u if index >= 0 else 0.0
        return earned + (self.new_cell if novel else 0.0)
