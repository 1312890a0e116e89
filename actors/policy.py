"""The policy that flies is a file: an ONNX model run by ONNX Runtime on one thread. No torch in the process."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime as ort

from actors.planners import Sight
from tmc.kernel.config import Config
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.observation import Observer
from tmc.kernel.policy import INPUT, KEY, OUTPUT, PolicyCard, PolicyError, require


def open_model(model: bytes) -> tuple[Any, PolicyCard]:
    """The session and the description of a policy file; raises PolicyError when it is none."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # a broken file is reported by us, in one sentence
    try:
        session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception:  # ONNX Runtime raises its own kinds, which it does not export
        raise PolicyError("the file is no ONNX model that ONNX Runtime can read") from None
    text = session.get_modelmeta().custom_metadata_map.get(KEY)
    if text is None:
        raise PolicyError("the ONNX model is not an Overfly policy: it has no description")
    return session, PolicyCard.from_json(text)


def read_card(model: bytes) -> PolicyCard:
    """The description in a policy file."""
    return open_model(model)[1]


class NetworkDecider:
    """argmax_a Q(o, a; theta), over the allowed actions when the policy was trained to mask blocked moves."""

    def __init__(self, model: bytes, config: Config, observer: Observer) -> None:
        self._session, card = open_model(model)
        require(card, config, observer.grid)
        self._mask, self._canvas = config.exploration.mask_blocked, observer.canvas()
        self._q = np.zeros((1, N_ACTIONS), np.float32)
        self._seen: Sight | None = None
        self._check()
        self._bound = self._bind()

    def _bind(self) -> Any:
        """Tell ONNX Runtime once where image and values are: a call takes a fifth less time than one that is told."""
        bound = self._session.io_binding()
        image, q = self._canvas.image, self._q
        bound.bind_input(INPUT, "cpu", 0, np.float32, image.shape, image.ctypes.data)
        bound.bind_output(OUTPUT, "cpu", 0, np.float32, q.shape, q.ctypes.data)
        return bound

    def _check(self) -> None:
        """One forward pass, so that a model of another shape, or one that is not finite, is refused before it flies."""
        try:
            given = self._session.run([OUTPUT], {INPUT: self._canvas.image})[0]
        except Exception:
            raise PolicyError("the policy does not accept the observation that its description promises") from None
        if given.shape != self._q.shape or not np.isfinite(given).all():
            raise PolicyError("the policy does not give nine finite action values")

    def q_values(self) -> np.ndarray[Any, np.dtype[np.float32]]:
        """Q of the nine actions for the observation on the canvas; the next call writes over them."""
        self._session.run_with_iobinding(self._bound)
        q: np.ndarray[Any, np.dtype[np.float32]] = self._q[0]
        return q

    def choose(self, sight: Sight) -> int:
        q = self._look(sight)
        if self._mask:
            return max(sight.allowed, key=q.tolist().__getitem__)
        return int(q.argmax())

    def worth(self, sight: Sight, action: int) -> tuple[float, float]:
        """Q(o, a), and the largest Q(o, .) among the actions that `choose` chooses from."""
        q = self._look(sight).tolist()
        return q[action], max(q[a] for a in sight.allowed) if self._mask else max(q)

    def _look(self, sight: Sight) -> np.ndarray[Any, np.dtype[np.float32]]:
        """Q of what is in sight; who asks again about the last one gets what was computed."""
        if sight is not self._seen:
            self._canvas.draw(sight.cell, sight.peers, sight.u)
            self.q_values()
            self._seen = sight
        q: np.ndarray[Any, np.dtype[np.float32]] = self._q[0]
        return q
