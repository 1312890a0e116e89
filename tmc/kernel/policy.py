"""What a policy file says of itself: the description inside an ONNX model, so that no policy flies where it cannot."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields

from tmc.kernel.config import Config, ConfigError, Network
from tmc.kernel.grid import N_ACTIONS, Grid

FORMAT = 1
KEY = "overfly"
"""Name of the metadata entry of the ONNX model that holds the description as JSON."""
INPUT, OUTPUT = "observation", "q"
"""Names of the model's input, (batch, channels, height, width) float32, and output, (batch, 9) float32."""
N_CHANNELS = 3


class PolicyError(ValueError):
    """A policy that cannot fly here: one sentence with the mend."""


@dataclass(frozen=True)
class PolicyCard:
    """The description. `view`, `radius`, `near`: as in the settings `observation.*` it was trained with."""

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
        return json.dumps(asdict(self), sort_keys=True)

    @staticmethod
    def from_json(text: str) -> PolicyCard:
        try:
            card = PolicyCard(**json.loads(text))
        except (TypeError, ValueError, RecursionError):
            raise PolicyError("the file is not an Overfly policy: its description cannot be read") from None
        if any(type(getattr(card, f.name)).__name__ != f.type for f in fields(PolicyCard)):
            raise PolicyError("the file is not an Overfly policy: its description has values of the wrong type")
        if card.format != FORMAT:
            raise PolicyError(f"the policy has format {card.format}, this Overfly reads format {FORMAT}")
        return card


def view_shape(config: Config, grid: Grid) -> tuple[int, int, int]:
    """(channels, height, width) of an observation under these settings."""
    if config.observation.view == "ego":
        side = 2 * config.observation.radius + 1
        return N_CHANNELS, side, side
    return N_CHANNELS, grid.rows, grid.cols


def features(network: Network, height: int, width: int) -> tuple[int, int]:
    """Rows and columns after the last convolution, with `padding`; raises ConfigError when a view is too small."""
    if not _sides(network, min(height, width)):
        raise ConfigError(
            f"a view of {height} x {width} cells is too small for {len(network.channels)} convolutions with "
            f"network.kernel = {network.kernel} and network.stride = {network.stride}: lower these, "
            "or raise observation.radius"
        )
    rows, cols = (_sides(network, n + padding(network, n))[-1] for n in (height, width))
    return rows, cols


def padding(network: Network, side: int) -> int:
    """Rows or columns of zeros that are put behind the last one, so that every cell of `side` counts.

    Kernels that go in strides may leave some over at the end: of 17 cells, two of 4 by strides of 2 see 14. The paper's
    30 they see whole, without padding.
    """
    more = 0
    while not _sides(network, side + more) or _left_over(network, side + more):
        more += 1
    return more


def _sides(network: Network, side: int) -> list[int]:
    """What is left of `side` after each convolution; empty when it is too small for one of them."""
    sides = []
    for _ in network.channels:
        if side < network.kernel:
            return []
        side = (side - network.kernel) // network.stride + 1
        sides.append(side)
    return sides


def _left_over(network: Network, side: int) -> bool:
    """Whether a convolution sees less than all of what it is given."""
    given = [side, *_sides(network, side)[:-1]]
    return any((n - network.kernel) % network.stride for n in given)


def check_view(config: Config, shape: tuple[int, int, int]) -> None:
    """Raise ConfigError when the network of these settings cannot take observations of this shape."""
    near = config.observation.near
    if 2 * near + 1 > min(shape[1:]):
        raise ConfigError(
            f"observation.near = {near} is larger than the view: choose {(min(shape[1:]) - 1) // 2} or less"
        )
    features(config.network, *shape[1:])


def card_for(config: Config, grid: Grid, version: int, updates: int) -> PolicyCard:
    """The description of a policy trained with these settings."""
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
