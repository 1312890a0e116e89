"""Exports the policy file: the Q-network as an ONNX model that carries its own card.

The graph is written node by node, because torch's exporter would take seconds per published policy. The network has
only five operators.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from learner.qnet import QNet, middle
from tmc.kernel.policy import INPUT, KEY, OUTPUT, PolicyCard

OPSET, IR = 17, 9
"""Versions of the operators and of the file: ONNX Runtime 1.18 and later read both."""
BATCH = "batch"


def to_onnx(net: QNet, card: PolicyCard) -> bytes:
    """Return the network as an ONNX file: INPUT (batch, C, H, W) float32, OUTPUT (batch, 9) float32, card under KEY.

    The same weights and the same card give the same bytes.
    """
    graph = helper.make_graph(
        _nodes(net),
        "overfly",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, [BATCH, *net.shape])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, [BATCH, net.out.out_features])],
        _initializers(net),
    )
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=IR, producer_name="overfly")
    helper.set_model_props(model, {KEY: card.to_json()})
    data: bytes = model.SerializeToString(deterministic=True)
    return data


def _nodes(net: QNet) -> list[Any]:
    """Return QNet.forward as ONNX operators."""
    nodes, x = [], INPUT
    for i in range(len(net.convs)):
        padding = {"pads": [0, 0, *net.pad]} if i == 0 and any(net.pad) else {}
        strides = [net.stride, net.stride]
        nodes += [
            helper.make_node("Conv", [x, *_layer(f"convs.{i}")], [f"conv{i}"], strides=strides, **padding),
            helper.make_node("Relu", [f"conv{i}"], [f"relu{i}"]),
        ]
        x = f"relu{i}"
    nodes.append(helper.make_node("Flatten", [x], ["flat"], axis=1))
    if net.near:
        nodes += _crop_nodes()
    return [
        *nodes,
        helper.make_node("Gemm", ["features" if net.near else "flat", *_layer("dense")], ["hidden"], transB=1),
        helper.make_node("Relu", ["hidden"], ["active"]),
        helper.make_node("Gemm", ["active", *_layer("out")], [OUTPUT], transB=1),
    ]


def _crop_nodes() -> list[Any]:
    """Return QNet.crop as ONNX operators, appended to the features of the convolutions."""
    return [
        helper.make_node("Slice", [INPUT, "crop.starts", "crop.ends", "crop.axes"], ["crop"]),
        helper.make_node("Flatten", ["crop"], ["near"], axis=1),
        helper.make_node("Concat", ["flat", "near"], ["features"], axis=1),
    ]


def _layer(name: str) -> list[str]:
    return [f"{name}.weight", f"{name}.bias"]


def _initializers(net: QNet) -> list[Any]:
    """Return the weights, by their names in the network, and the bounds of the crop."""
    arrays = {name: w.detach().numpy() for name, w in net.named_parameters()}
    if net.near:
        (top, bottom), (left, right) = (middle(side, net.near) for side in net.shape[1:])
        bounds = {"starts": [top, left], "ends": [bottom, right], "axes": [2, 3]}
        arrays |= {f"crop.{name}": np.array(v, np.int64) for name, v in bounds.items()}
    return [numpy_helper.from_array(np.ascontiguousarray(a), name) for name, a in arrays.items()]
