"""Checks a policy file before it flies: is it an ONNX model of one piece, and does it have the shapes of its card?"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from tmc.kernel.files import plain
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.policy import INPUT, OUTPUT, PolicyCard, PolicyError
from tmc.wire.capacity import check_policy

_EXPORT = "export it to ONNX, as policies/final.onnx of a run is"
_UNPACK = "unpack it first"
_OUTSIDE = b"\n\x08location\x12"
"""The key of TensorProto.external_data under which ONNX names a file outside the model that holds a weight."""


def _begins(*starts: bytes) -> Callable[[bytes], bool]:
    return lambda data: data.startswith(starts)


def _is_text(data: bytes) -> bool:
    """Return whether the data begin as plain text does; a model begins with the number of a field."""
    return all(32 <= byte < 127 or byte in b"\t\r\n" for byte in data[:64])


KINDS: tuple[tuple[Callable[[bytes], bool], str], ...] = (
    (lambda data: not data, "the file is empty: copy it again"),
    (_begins(b"version https://git-lfs"), "the file is a Git LFS pointer, not the model: fetch it with `git lfs pull`"),
    (lambda data: re.match(rb"(\xef\xbb\xbf)?\s*<(!doctype|html|head|\?xml)", data[:200], re.IGNORECASE) is not None,
     "the file is a web page: download the raw file"),
    (_is_text, "the file is text, not an ONNX model: give a policy file, such as policies/final.onnx of a run"),
    (lambda data: data.startswith(b"PK") and b"data.pkl" in data,
     f"the file is a PyTorch checkpoint, not an ONNX model: {_EXPORT}"),
    (_begins(b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"),
     f"the file is a Python pickle, as old PyTorch checkpoints are, not an ONNX model: {_EXPORT}"),
    (lambda data: data[7:10] in (b"\x00{\"", b"\x00{ "),
     "the file is a safetensors file, such as a checkpoint, not an ONNX model: give policies/final.onnx of the run"),
    (_begins(b"PK\x03\x04"), f"the file is a zip archive: {_UNPACK}"),
    (_begins(b"\x1f\x8b"), f"the file is packed with gzip: {_UNPACK}"),
    (_begins(b"\x28\xb5\x2f\xfd", b"\xfd7zXZ\x00", b"BZh", b"7z\xbc\xaf"), f"the file is packed: {_UNPACK}"),
    (_begins(b"\x89HDF"), f"the file is HDF5, as Keras writes it, not an ONNX model: {_EXPORT}"),
    (_begins(b"\x89MCAP"), "the file is a log, not an ONNX model: give a policy file, or the folder of the run"),
    (lambda data: _OUTSIDE in data,
     "the weights of the ONNX model lie in another file: export it again with them inside (external_data=False)"),
)  # fmt: skip
"""(test of the bytes, sentence with cause and fix) for each kind of file that cannot be used as a policy."""


def check_kind(model: bytes) -> None:
    """Raise PolicyError for a file that is known not to be an ONNX model of one piece."""
    check_policy(len(model))
    for is_kind, sentence in KINDS:
        if is_kind(model):
            raise PolicyError(sentence)


def reason(error: Exception) -> str:
    """Return why ONNX Runtime refused a model, as part of a sentence, without file names and lines of its source."""
    text = plain(error, 2000)
    text = re.sub(r"\[ONNXRuntimeError\] : \d+ : \w+ :", " ", text)
    text = re.sub(r"\S*/\S+\.(cc|h):\d+ .*?\)(?= [A-Z])", " ", text)  # the place, and the signature of the function
    text = re.sub(r"Load model from \S* failed:|Error in execution:|This is an invalid model\.", " ", text)
    return plain(" ".join(text.split()).rstrip(". "), 160) or "it gives no reason"


def check_shapes(session: Any, card: PolicyCard) -> None:
    """Raise PolicyError unless the model takes INPUT alone and gives OUTPUT, with the types and shapes of its card.

    A dimension that the model leaves open fits. Other outputs of the model are ignored.
    """
    inputs = {given.name: given for given in session.get_inputs()}
    outputs = {given.name: given for given in session.get_outputs()}
    if set(inputs) != {INPUT}:
        raise PolicyError(f"the model takes {_names(inputs)}: it must take '{INPUT}' alone")
    if OUTPUT not in outputs:
        raise PolicyError(f"the model gives {_names(outputs)}: it must give '{OUTPUT}'")
    _check_shape(inputs[INPUT], (1, card.channels, card.height, card.width))
    _check_shape(outputs[OUTPUT], (1, N_ACTIONS))


def _check_shape(given: Any, shape: tuple[int, ...]) -> None:
    """Raise PolicyError unless an input or output can be a float32 tensor of this shape."""
    name, sides = given.name, list(given.shape)
    if given.type != "tensor(float)":
        raise PolicyError(f"the model's '{name}' is a {plain(given.type, 40)}: it must be a tensor(float), of float32")
    fits = all(not isinstance(side, int) or side == wanted for side, wanted in zip(sides, shape, strict=False))
    if sides and (len(sides) != len(shape) or not fits):
        had = plain([side if isinstance(side, int) else "any" for side in sides], 60)
        raise PolicyError(f"the model's '{name}' has the shape {had.replace(chr(39), '')}: it must be {list(shape)}")


def _names(found: dict[str, Any]) -> str:
    return plain(", ".join(f"'{name}'" for name in found) or "nothing", 80)
