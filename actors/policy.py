"""Flies a policy file: an ONNX model, run by ONNX Runtime on one thread. There is no torch in the process."""

from __future__ import annotations

import os
from typing import Any

# Otherwise importing ONNX Runtime starts a telemetry thread, and a UAV is forked from a process without threads.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import numpy as np
import onnxruntime as ort

from actors.modelfile import check_kind, check_shapes, reason
from actors.planners import LocalState
from tmc.kernel.config import Config
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.policy import INPUT, KEY, OUTPUT, FlightError, PolicyCard, PolicyError, require


def open_model(model: bytes) -> tuple[Any, PolicyCard]:
    """Open a policy file; return its ONNX Runtime session and its card. Raises PolicyError."""
    check_kind(model)
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # Overfly reports a broken file itself, in one sentence
    try:
        session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime does not export the classes that it raises
        raise PolicyError(f"ONNX Runtime {ort.__version__} cannot use the model ({reason(error)})") from None
    text = session.get_modelmeta().custom_metadata_map.get(KEY)
    if text is None:
        raise PolicyError("the ONNX model is not an Overfly policy: it has no description")
    card = PolicyCard.from_json(text)
    check_shapes(session, card)
    return session, card


def read_card(model: bytes) -> PolicyCard:
    """Return the card of a policy file. Raises PolicyError."""
    return open_model(model)[1]


def run_model(session: Any, observations: np.ndarray[Any, Any]) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Q of B observations, (B, 3, height, width) float32 -> (B, 9). Raises PolicyError when the model cannot be run."""
    try:
        q: np.ndarray[Any, np.dtype[np.float32]] = session.run([OUTPUT], {INPUT: np.ascontiguousarray(observations)})[0]
    except Exception as error:  # ONNX Runtime raises its own kinds
        raise PolicyError(f"the model could not be run ({reason(error)})") from None
    if q.shape != (len(observations), N_ACTIONS):
        raise PolicyError(f"the model gives values of shape {list(q.shape)}: it must be [{len(observations)}, 9]")
    return q


class PolicyController:
    """Chooses argmax_a Q(o, a; theta), over the allowed actions when the policy was trained to mask blocked moves.

    Raises PolicyError for a model that does not fit the mission or cannot be run.
    """

    def __init__(self, model: bytes, config: Config, observer: ObservationBuilder) -> None:
        self._session, card = open_model(model)
        require(card, config, observer.grid)
        self._mask, self._canvas = config.exploration.mask_blocked, observer.canvas()
        self._q = np.zeros((1, N_ACTIONS), np.float32)
        self._values: list[float] = []
        """Q(o, .) of the nine actions in `_last_state`."""
        self._last_state: LocalState | None = None
        self._binding = self._bind()
        self._check(observer)

    def _bind(self) -> Any:
        """Bind the memory of image and values once: it makes a call a fifth faster than passing arrays each time."""
        bound = self._session.io_binding()
        image, q = self._canvas.image, self._q
        bound.bind_input(INPUT, "cpu", 0, np.float32, image.shape, image.ctypes.data)
        bound.bind_output(OUTPUT, "cpu", 0, np.float32, q.shape, q.ctypes.data)
        return bound

    def _check(self, observer: ObservationBuilder) -> None:
        """Raise PolicyError for a model that cannot be run, or gives other values for the same observation.

        Values that are not finite are found in flight only.
        """
        self._canvas.draw(observer.first_cell, [], np.zeros(observer.R))
        try:
            given = self._session.run([OUTPUT], {INPUT: self._canvas.image})[0]
            if given.shape == self._q.shape:
                self._run()
        except Exception as error:
            raise PolicyError(f"the model does not take the observation of its description ({reason(error)})") from None
        if given.shape != self._q.shape:
            raise PolicyError(f"the model gives values of shape {list(given.shape)}: it must be {list(self._q.shape)}")
        if not np.array_equal(given, self._q, equal_nan=True):
            raise PolicyError("the model gives other values when it sees the same again: it must not draw at random")

    def _run(self) -> None:
        self._session.run_with_iobinding(self._binding)

    def q_values(self) -> np.ndarray[Any, np.dtype[np.float32]]:
        """Return Q (9,) float32 for the observation on the canvas; the next call overwrites it."""
        self._run()
        q: np.ndarray[Any, np.dtype[np.float32]] = self._q[0]
        return q

    def choose(self, state: LocalState) -> int:
        """Return the action with the largest Q. Raises FlightError."""
        q = self._q_of_state(state)
        if self._mask:
            return max(state.allowed, key=q.__getitem__)
        return q.index(max(q))

    def q_of(self, state: LocalState, action: int) -> tuple[float, float]:
        """Return Q(o, a), and the largest Q(o, .) of the actions that `choose` chooses from. Raises FlightError."""
        q = self._q_of_state(state)
        return q[action], max(q[a] for a in state.allowed) if self._mask else max(q)

    def _q_of_state(self, state: LocalState) -> list[float]:
        """Return Q(o, .) of the nine actions, computed once for repeated calls with one state. Raises FlightError."""
        if state is not self._last_state:
            self._canvas.draw(state.cell, state.peers, state.u)
            try:
                values: list[float] = self.q_values().tolist()
            except Exception as error:  # as above: whether a model runs may depend on its input
                raise FlightError(f"could not be run ({reason(error)})") from None
            total = sum(values)
            if total - total != 0.0:  # the sum is finite exactly if all values are
                shown = ", ".join(f"{value:.3g}" for value in values)
                raise FlightError(f"gave values that are not finite ({shown})")
            self._values, self._last_state = values, state
        return self._values
