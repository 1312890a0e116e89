"""The description inside an ONNX policy file, so that a policy that does not fit a mission is refused."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields

from tmc.kernel.config import Config, ConfigError, NetworkConfig, build
from tmc.kernel.errors import OverflyError
from tmc.kernel.files import plain
from tmc.kernel.grid import N_ACTIONS, Grid

FORMAT = 1
KEY = "overfly"
"""Name of the metadata entry of the ONNX model that holds the description as JSON."""
INPUT, OUTPUT = "observation", "q"
"""Names of the model's input, (batch, channels, height, width) float32, and output, (batch, 9) float32."""
N_CHANNELS = 3


class PolicyError(OverflyError, ValueError):
    """A policy cannot fly here. The text is one sentence with the fix."""


class FlightError(PolicyError):
    """A policy failed in flight, which its file did not show."""


_RANGES = {
    "channels": (N_CHANNELS, N_CHANNELS), "height": (1, 65_535), "width": (1, 65_535),
    "actions": (N_ACTIONS, N_ACTIONS), "scenario": (1, 2), "version": (0, 2**62), "updates": (0, 2**62),
}  # fmt: skip
"""Ranges of the numbers in a description. Numbers that are settings too have the ranges of the settings."""


@dataclass(frozen=True)
class PolicyCard:
    """The description of a policy. `view`, `radius`, `near`: its settings `observation.*` in training."""

    channels: int
    height: int
    width: int
    actions: int
    view: str
    radius: int
    near: int
    mask_blocked: bool
    scenario: int
    version: int
    updates: int
    format: int = FORMAT

    def to_json(self) -> str:
        """Return the description as JSON."""
        return json.dumps(asdict(self), sort_keys=True)

    @staticmethod
    def from_json(text: str) -> PolicyCard:
        """Parse a description; PolicyError unless every value is valid."""
        prefix = "the file is not an Overfly policy: its description"
        try:
            found = json.loads(text)
        except (ValueError, RecursionError):
            raise PolicyError(f"{prefix} is not JSON") from None
        if not isinstance(found, dict):
            raise PolicyError(f"{prefix} is not a JSON object")
        if type(found.get("format")) is int and found["format"] != FORMAT:
            raise PolicyError(f"the policy has format {plain(found['format'], 40)}, this Overfly reads format {FORMAT}")
        names = {f.name for f in fields(PolicyCard)}
        if missing := sorted(names - found.keys() - {"format"}):
            raise PolicyError(f"{prefix} lacks {', '.join(missing)}")
        if unknown := sorted(found.keys() - names):
            raise PolicyError(f"{prefix} has the unknown key {plain(unknown[0], 40)!r}")
        card = PolicyCard(**found)
        if wrong := card._wrong():
            raise PolicyError(f"{prefix} has {wrong}")
        return card

    def _wrong(self) -> str:
        """Return the first invalid value, and what is valid; empty when there is none."""
        for f in fields(PolicyCard):
            value = getattr(self, f.name)
            if type(value).__name__ != f.type:
                return f"{f.name} = {plain(repr(value), 40)}, a value of the wrong type: it must be of type {f.type}"
            if f.name in _RANGES and not _RANGES[f.name][0] <= value <= _RANGES[f.name][1]:
                low, high = _RANGES[f.name]
                return f"{plain(value, 40)} {f.name}: it must be {low}" + ("" if low == high else f" to {high}")
        try:
            build({"observation.view": self.view, "observation.radius": self.radius, "observation.near": self.near})
        except ConfigError as error:
            return f"an invalid view ({plain(error, 120)})"
        side = 2 * self.radius + 1
        if self.view == "ego" and (self.height, self.width) != (side, side):
            return f"{self.height} x {self.width} cells, where a radius of {self.radius} has {side} x {side}"
        return ""


def view_shape(config: Config, grid: Grid) -> tuple[int, int, int]:
    """Return (channels, height, width) of an observation under these settings."""
    if config.observation.view == "ego":
        side = 2 * config.observation.radius + 1
        return N_CHANNELS, side, side
    return N_CHANNELS, grid.rows, grid.cols


def features(network: NetworkConfig, height: int, width: int) -> tuple[int, int]:
    """Return rows and columns after the last convolution, with `padding`; ConfigError when a view is too small."""
    if not _sides(network, min(height, width)):
        raise ConfigError(
            f"a view of {height} x {width} cells is too small for {len(network.channels)} convolutions with "
            f"network.kernel = {network.kernel} and network.stride = {network.stride}: lower these, "
            "or raise observation.radius"
        )
    rows, cols = (_sides(network, n + padding(network, n))[-1] for n in (height, width))
    return rows, cols


def padding(network: NetworkConfig, side: int) -> int:
    """Return the rows or columns of zeros to append, so that the convolutions see every cell of `side`.

    With strides, kernels may leave out the last cells: of 17 cells, two kernels of 4 with strides of 2 see 14. The
    paper's 30 cells need no padding.
    """
    more = 0
    while not _sides(network, side + more) or _left_over(network, side + more):
        more += 1
    return more


def _sides(network: NetworkConfig, side: int) -> list[int]:
    """Return the side after each convolution; empty when `side` is too small."""
    sides = []
    for _ in network.channels:
        if side < network.kernel:
            return []
        side = (side - network.kernel) // network.stride + 1
        sides.append(side)
    return sides


def _left_over(network: NetworkConfig, side: int) -> bool:
    """Return True when a convolution leaves out cells of its input."""
    given = [side, *_sides(network, side)[:-1]]
    return any((n - network.kernel) % network.stride for n in given)


def policy_bytes(config: Config, shape: tuple[int, int, int]) -> int:
    """Estimate the size of a policy file, bytes: the weights, and room for their names."""
    network, (channels, height, width) = config.network, shape
    rows, cols = features(network, height, width)
    sizes, before = [], channels
    for filters in network.channels:
        sizes.append((before * network.kernel**2 + 1) * filters)
        before = filters
    near = (2 * config.observation.near + 1) ** 2 if config.observation.near else 0
    sizes += [(before * rows * cols + channels * near + 1) * network.dense, (network.dense + 1) * N_ACTIONS]
    return 4 * sum(sizes) + 1024 * (len(sizes) + 1)


def check_view(config: Config, shape: tuple[int, int, int]) -> None:
    """Raise ConfigError when the network of these settings does not fit observations of this shape."""
    near = config.observation.near
    if 2 * near + 1 > min(shape[1:]):
        raise ConfigError(
            f"observation.near = {near} is larger than the view: choose {(min(shape[1:]) - 1) // 2} or less"
        )
    features(config.network, *shape[1:])


def card_for(config: Config, grid: Grid, version: int, updates: int) -> PolicyCard:
    """Return the description of a policy that is trained with these settings."""
    channels, height, width = view_shape(config, grid)
    view = config.observation
    return PolicyCard(
        channels, height, width, N_ACTIONS, view.view, view.radius, view.near,
        config.exploration.mask_blocked, config.scenario, version, updates,
    )  # fmt: skip


def require(card: PolicyCard, config: Config, grid: Grid) -> None:
    """Raise PolicyError unless a policy with this card can fly a mission with these settings."""
    shape = view_shape(config, grid)
    if (card.channels, card.height, card.width) != shape or card.view != config.observation.view:
        was = f"{card.view} view, {card.channels} channels of {card.height} x {card.width} cells"
        now = f"{config.observation.view} view, {shape[0]} channels of {shape[1]} x {shape[2]} cells"
        raise PolicyError(f"the policy was made for {was}, this mission has {now}: choose the map it was trained on")
    if card.actions != N_ACTIONS:
        raise PolicyError(f"the policy has {card.actions} actions, a UAV has {N_ACTIONS}")
