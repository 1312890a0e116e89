"""The policy that flies is a file: an ONNX model run by ONNX Runtime on one thread. No torch in the process."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime as ort

from actors.planners import Sight
from tmc.kernel.config import Config
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
        self._observer, self._mask = observer, config.exploration.mask_blocked
        self._image = np.zeros((1, *observer.shape), np.float32)
        self._inputs, self._outputs = {INPUT: self._image}, [OUTPUT]
        self._check()

    def _check(self) -> None:
        """One forward pass, so that a model of another shape, or one that is not finite, is refused before it flies."""
        try:
            q = self.q_values()
        except Exception:
            raise PolicyError("the policy does not accept the observation that its description promises") from None
        if q.shape != (9,) or not np.isfinite(q).all():
            raise PolicyError("the policy does not give nine finite action values")

    def q_values(self) -> np.ndarray[Any, np.dtype[np.float32]]:
        """Q of the nine actions for the observation in the buffer."""
        q: np.ndarray[Any, np.dtype[np.float32]] = self._session.run(self._outputs, self._inputs)[0][0]
        return q

    def choose(self, sight: Sight) -> int:
        self._observer.observe(sight.cell, sight.peers, sight.u, self._image[0])
        q = self.q_values()
        if self._mask:
            return max(sight.allowed, key=q.tolist().__getitem__)
        return int(q.argmax())
