"""The policy file gives the values of the network that it was made from."""

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from learner import qnet, rounding
from learner.export import to_onnx
from tmc.kernel.config import build
from tmc.kernel.grid import Grid
from tmc.kernel.policy import INPUT, KEY, OUTPUT, PolicyCard, card_for, view_shape

GRID = Grid(30, 30)


def make(config):
    card = card_for(config, GRID, version=3, updates=200)
    net = qnet.build(config, view_shape(config, GRID)).to(memory_format=torch.channels_last)
    return net, card, to_onnx(net, card)


def session_of(model):
    return onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize("batch", [1, 5])
def test_onnxruntime_gives_what_torch_gives(preset, batch):
    net, _, model = make(preset)
    o = np.random.Generator(np.random.Philox(batch)).random((batch, *net.shape)).astype("f4")
    (q,) = session_of(model).run([OUTPUT], {INPUT: o})
    assert q.shape == (batch, 9)
    assert_values_of(net, o, q)


def assert_values_of(net, o, q):
    """Assert that `q` is the network's output, within float32 rounding."""
    exact = rounding.Net(net).forward(torch.tensor(o))
    assert ((torch.tensor(q).double() - exact.value).abs() <= exact.error).all()


@pytest.mark.parametrize(
    "values",
    [
        {"network.channels": (8,), "network.kernel": 3, "network.stride": 1},
        {"network.channels": (4, 4, 4), "network.kernel": 2, "observation.view": "ego", "observation.near": 8},
    ],
)
def test_other_networks_are_exported_too(values):
    net, _, model = make(build(values))
    o = np.random.Generator(np.random.Philox(9)).random((2, *net.shape)).astype("f4")
    (q,) = session_of(model).run([OUTPUT], {INPUT: o})
    assert_values_of(net, o, q)


def test_the_model_carries_its_card(preset):
    _, card, model = make(preset)
    assert PolicyCard.from_json(session_of(model).get_modelmeta().custom_metadata_map[KEY]) == card


def test_the_model_is_valid_and_old_enough_for_onnxruntime_1_18(preset):
    net, _, data = make(preset)
    model = onnx.load_from_string(data)
    onnx.checker.check_model(model, full_check=True)
    assert (model.ir_version, [o.version for o in model.opset_import]) == (9, [17])
    (entry,), (result,) = session_of(data).get_inputs(), session_of(data).get_outputs()
    assert (entry.name, entry.shape, entry.type) == (INPUT, ["batch", *net.shape], "tensor(float)")
    assert (result.name, result.shape) == (OUTPUT, ["batch", 9])


def test_the_same_network_gives_the_same_bytes(preset):
    assert make(preset)[2] == make(preset)[2]


def test_export_copies_the_weights_and_runs_no_network(paper, monkeypatch):
    """So it takes milliseconds, where a trace takes seconds."""
    net, card, model = make(paper)
    monkeypatch.setattr(qnet.QNet, "forward", lambda *_: pytest.fail("the network was run"))
    assert to_onnx(net, card) == model
