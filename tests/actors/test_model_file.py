"""A policy file from elsewhere: its declarations are checked before a flight, each of its values in flight."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from actors.modelfile import reason
from actors.planners import LocalState
from actors.policy import PolicyController, open_model
from tmc.kernel.config import build
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.policy import INPUT, KEY, OUTPUT, FlightError, PolicyError, card_for
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World

EGO = {"observation.view": "ego", "observation.radius": 1, "team.size": 2}
SHAPE = (3, 3, 3)
FLOAT = TensorProto.FLOAT


@pytest.fixture
def world(town: RoadMap) -> World:
    return World(build(EGO), town)


def model_of(
    world: World,
    nodes: list[Any],
    *,
    weights: dict[str, Any] | None = None,
    takes: Any = ("batch", *SHAPE),
    gives: Any = ("batch", 9),
    types: tuple[int, int] = (FLOAT, FLOAT),
    more_inputs: tuple[Any, ...] = (),
    card: dict[str, Any] | None = None,
    opset: int = 17,
) -> bytes:
    """Return a model of these nodes with the card of the world, or with what a test replaces either by."""
    inputs = [helper.make_tensor_value_info(INPUT, types[0], takes), *more_inputs]
    outputs = [helper.make_tensor_value_info(OUTPUT, types[1], gives)]
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in (weights or {}).items()]
    graph = helper.make_graph(nodes, "test", inputs, outputs, tensors)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=9)
    facts = json.loads(card_for(world.config, world.grid, 1, 0).to_json()) | (card or {})
    helper.set_model_props(made, {KEY: json.dumps(facts)})
    data: bytes = made.SerializeToString()
    return data


def linear(weights: np.ndarray[Any, Any] | None = None, before: tuple[Any, ...] = (), x: str = INPUT) -> dict[str, Any]:
    """Return nodes and weights of a policy that is linear in `x`."""
    table = np.zeros((27, 9), np.float32) if weights is None else weights
    nodes = [*before, helper.make_node("Flatten", [x], ["flat"]), helper.make_node("MatMul", ["flat", "w"], [OUTPUT])]
    return {"nodes": nodes, "weights": {"w": table.astype(np.float32)}}


def controller(model: bytes, world: World) -> PolicyController:
    return PolicyController(model, world.config, ObservationBuilder(world))


def refused(model: bytes, world: World) -> str:
    with pytest.raises(PolicyError) as error:
        controller(model, world)
    text = str(error.value)
    assert text.isprintable() and 20 < len(text) < 300
    return text


def state(world: World, peers: list[int] | None = None, u: float = 0.5) -> LocalState:
    cell = int(world.start_cells[0])
    values = np.full(world.law.cells.size, u)
    return LocalState(0, cell, cell, peers or [], values, list(range(9)), 0.0)


# What it declares


def test_the_policy_of_these_tests_flies(world: World) -> None:
    table = np.zeros((27, 9))
    table[:, 6] = 1.0
    assert controller(model_of(world, **linear(table)), world).choose(state(world)) == 6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"takes": (1, 3, 3, 3), "gives": (1, 9)}, None),
        ({"takes": ("b", "c", "h", "w"), "gives": ("b", "q")}, None),
        ({"gives": None}, None),
        ({"takes": (2, 3, 3, 3), "gives": (2, 9)}, "'observation' has the shape [2, 3, 3, 3]: it must be [1, 3, 3, 3]"),
        ({"table": np.zeros((9, 9)), "takes": ("b", 3, 3)}, "'observation' has the shape [any, 3, 3]: it must be"),
        ({"table": np.zeros((9, 9)), "takes": ("b", 1, 3, 3)}, "'observation' has the shape [any, 1, 3, 3]"),
        ({"card": {"radius": 2}}, "3 x 3 cells, where a radius of 2 has 5 x 5"),
        ({"card": {"height": 0}}, "0 height: it must be 1 to 65535"),
        ({"card": {"width": 10**9}}, "1000000000 width"),
        ({"card": {"radius": float("nan")}}, "radius = nan, a value of the wrong type"),
        ({"card": {"mask_blocked": 1}}, "mask_blocked = 1, a value of the wrong type"),
        ({"card": {"view": "sideways"}}, "an invalid view (observation.view = 'sideways' is none of whole, ego)"),
        ({"card": {"view": "\x1b[2J" + "x" * 5000}}, "an invalid view"),
        ({"card": {"near": 100}}, "an invalid view"),
        ({"card": {"version": -1}}, "-1 version"),
        ({"card": {"colour": "red"}}, "the unknown key 'colour'"),
        ({"card": {"format": 2}}, "has format 2, this Overfly reads format 1"),
    ],
)  # fmt: skip
def test_what_a_model_declares(world: World, change: dict[str, Any], words: str | None) -> None:
    change = dict(change)
    model = model_of(world, **linear(change.pop("table", None)), **change)
    if words is None:
        controller(model, world).choose(state(world))
    else:
        assert words in refused(model, world)


def test_a_model_that_wants_more_than_an_observation(world: World) -> None:
    extra = helper.make_tensor_value_info("hour", FLOAT, [1, 27])
    add = helper.make_node("Add", ["flat", "hour"], ["both"])
    made = linear()
    made["nodes"] = [made["nodes"][0], add, helper.make_node("MatMul", ["both", "w"], [OUTPUT])]
    text = refused(model_of(world, **made, more_inputs=(extra,)), world)
    assert text == "the model takes 'observation', 'hour': it must take 'observation' alone"


def test_a_model_of_another_type(world: World) -> None:
    cast = (helper.make_node("Cast", [INPUT], ["x"], to=FLOAT),)
    text = refused(model_of(world, **linear(before=cast, x="x"), types=(TensorProto.DOUBLE, FLOAT)), world)
    assert text == "the model's 'observation' is a tensor(double): it must be a tensor(float), of float32"
    made = linear()
    made["nodes"][-1] = helper.make_node("MatMul", ["flat", "w"], ["m"])
    made["nodes"].append(helper.make_node("Cast", ["m"], [OUTPUT], to=TensorProto.DOUBLE))
    assert "'q' is a tensor(double)" in refused(model_of(world, **made, types=(FLOAT, TensorProto.DOUBLE)), world)


def test_another_number_of_values_is_refused_declared_or_not(world: World) -> None:
    five = linear(np.zeros((27, 5)))
    assert "'q' has the shape [any, 5]: it must be [1, 9]" in refused(model_of(world, **five, gives=("b", 5)), world)
    assert "'q' has the shape [any, 5]: it must be [1, 9]" in refused(model_of(world, **five, gives=("b", "n")), world)


def test_what_a_model_gives_besides_is_not_asked_for(world: World) -> None:
    made = onnx.load_from_string(model_of(world, **linear()))
    made.graph.output.append(helper.make_tensor_value_info("flat", FLOAT, ["batch", 27]))
    controller(made.SerializeToString(), world).choose(state(world))


def test_a_policy_that_draws_at_random_is_refused(world: World) -> None:
    nodes = [helper.make_node("RandomNormal", [], [OUTPUT], shape=[1, 9])]
    assert "it must not draw at random" in refused(model_of(world, nodes, gives=(1, 9)), world)


def test_a_policy_that_does_not_look_flies(world: World) -> None:
    """Its values do not depend on the input, and must be returned all the same."""
    values = np.arange(9, dtype=np.float32)[None]
    nodes = [helper.make_node("Constant", [], [OUTPUT], value=numpy_helper.from_array(values))]
    assert controller(model_of(world, nodes, gives=(1, 9)), world).choose(state(world)) == 8


# What it gives


def only_positions() -> tuple[Any, ...]:
    """Return the nodes that select the channel of positions of the observation."""
    return (helper.make_node("Slice", [INPUT, "from", "to", "along"], ["p"]),)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("action", [0, 4, 8])
def test_a_value_that_is_not_finite_stops_the_flight(world: World, bad: float, action: int) -> None:
    """At any place among the nine, and also when another action is chosen."""
    values = np.arange(9, dtype=np.float32)[None]
    values[0, action] = bad
    nodes = [helper.make_node("Constant", [], [OUTPUT], value=numpy_helper.from_array(values))]
    flying = controller(model_of(world, nodes, gives=(1, 9)), world)
    with pytest.raises(FlightError, match=r"gave values that are not finite \(.*\b(nan|inf)\b.*\)"):
        flying.choose(state(world))
    with pytest.raises(FlightError, match="not finite"):
        flying.q_of(state(world), 3)


def test_values_whose_sum_is_beyond_float32_are_finite(world: World) -> None:
    values = np.full((1, 9), 3e38, np.float32)
    nodes = [helper.make_node("Constant", [], [OUTPUT], value=numpy_helper.from_array(values))]
    assert controller(model_of(world, nodes, gives=(1, 9)), world).choose(state(world)) == 0


def test_a_policy_that_fails_only_on_what_it_sees_is_stopped_there(world: World) -> None:
    """log(1.25 - sum of P): finite with the UAV alone in the observation (1.0), NaN with a peer beside it (1.5)."""
    table = np.ones((1, 9))
    before = (
        *only_positions(),
        helper.make_node("ReduceSum", ["p", "axes"], ["sum"]),
        helper.make_node("Sub", ["limit", "sum"], ["left"]),
        helper.make_node("Log", ["left"], ["x"]),
    )
    made = linear(table, before, "x")
    made["weights"] |= {
        "axes": np.array([1, 2, 3]), "limit": np.array(1.25, np.float32),
        "from": np.array([0]), "to": np.array([1]), "along": np.array([1]),
    }  # fmt: skip
    flying = controller(model_of(world, **made), world)
    assert flying.choose(state(world)) == 0
    peer = next(k for k in world.grid.target_lists[int(world.start_cells[0])][:8] if k >= 0)
    with pytest.raises(FlightError, match="gave values that are not finite"):
        flying.choose(state(world, [peer]))
    assert flying.choose(state(world)) == 0


def test_a_policy_that_fails_only_on_what_it_never_sees_flies(world: World) -> None:
    """0 / 0 happens only on an image of zeros, and the UAV itself is always in the image."""
    table = np.zeros((27, 9))
    table[:9, 5] = 1.0  # the channel of positions
    made = linear(table, (*only_positions(), helper.make_node("ReduceSum", ["p", "axes"], ["sum"]),
                          helper.make_node("Div", [INPUT, "sum"], ["x"])), "x")  # fmt: skip
    made["weights"] |= {"axes": np.array([1, 2, 3]), "from": np.array([0]), "to": np.array([1]), "along": np.array([1])}
    model = model_of(world, **made)
    blank = ort.InferenceSession(model).run(None, {INPUT: np.zeros((1, *SHAPE), np.float32)})[0]
    assert np.isnan(blank).all()
    assert controller(model, world).choose(state(world)) == 5


def test_a_model_that_cannot_be_run_on_what_it_sees(world: World) -> None:
    """It gathers row 2 x U of a table of two rows, which exists for U = 0.5 and not for U = 1."""
    nodes = [
        helper.make_node("Slice", [INPUT, "from", "to", "along"], ["u"]),
        helper.make_node("ReduceMax", ["u"], ["most"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Mul", ["most", "two"], ["twice"]),
        helper.make_node("Cast", ["twice"], ["row"], to=TensorProto.INT64),
        helper.make_node("Gather", ["table", "row"], [OUTPUT]),
    ]
    weights = {"from": np.array([2]), "to": np.array([3]), "along": np.array([1]), "two": np.array(2, np.float32),
               "table": np.arange(18, dtype=np.float32).reshape(2, 9)}  # fmt: skip
    flying = controller(model_of(world, nodes, weights=weights), world)
    assert flying.choose(state(world, u=0.5)) == 8
    with pytest.raises(FlightError, match=r"could not be run \(.*row.*\)|could not be run \(.*bounds.*\)"):
        flying.choose(state(world, u=1.0))


# What else a file may be


def zipped(name: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, b"weights")
    return file.getvalue()


FILES = [
    (b"", "is empty"),
    (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12\n", "`git lfs pull`"),
    (b"\n<!DOCTYPE html>\n<html lang=en>", "is a web page: download the raw file"),
    (b"\xef\xbb\xbf<HTML>", "is a web page"),
    (b'{"message": "Not Found"}', "is text, not an ONNX model"),
    (zipped("archive/data.pkl"), "is a PyTorch checkpoint"),
    (b"\x80\x02}q\x00(X\x06\x00\x00\x00weight", "is a Python pickle"),
    (zipped("policy.onnx"), "is a zip archive: unpack it"),
    (b"\x1f\x8b\x08\x00" + bytes(60), "packed with gzip: unpack it"),
    (b"\x28\xb5\x2f\xfd" + bytes(60), "is packed: unpack it"),
    (b"\x40\x00\x00\x00\x00\x00\x00\x00" + b'{"w":{"dtype":"F32"}}', "is a safetensors file"),
    (b"\x89HDF\r\n\x1a\n" + bytes(60), "is HDF5"),
    (b"\x89MCAP0\r\n", "is a log"),
    (bytes(100), "ONNX Runtime .* cannot use the model"),
]


@pytest.mark.parametrize(("data", "words"), FILES, ids=[words[:24] for _, words in FILES])
def test_a_file_that_is_something_else_is_named(world: World, data: bytes, words: str) -> None:
    with pytest.raises(PolicyError, match=words):
        controller(data, world)


def test_a_file_that_no_message_takes_is_refused(world: World) -> None:
    with pytest.raises(PolicyError, match=r"it has 67,108,865 bytes, and a policy may have 67,108,864"):
        controller(bytes(2**26 + 1), world)


def test_weights_in_another_file_are_refused_though_it_is_there(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ONNX Runtime would read it from the current folder, and a run folder would not have it."""
    monkeypatch.chdir(tmp_path)
    made = onnx.load_from_string(model_of(world, **linear()))
    onnx.save(made, "p.onnx", save_as_external_data=True, location="p.data", size_threshold=0)
    assert "weights of the ONNX model lie in another file" in refused(Path("p.onnx").read_bytes(), world)


def changed(change: Callable[[Any], object]) -> Callable[[World], bytes]:
    def make(world: World) -> bytes:
        made = onnx.load_from_string(model_of(world, **linear()))
        change(made)
        data: bytes = made.SerializeToString()
        return data

    return make


def rename(model: Any) -> None:
    model.graph.node[0].op_type = "Fold\x1b[31m\nPaper"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (changed(lambda m: setattr(m, "ir_version", 99)), "(Unsupported model IR version: 99"),
        (changed(lambda m: setattr(m.opset_import[0], "version", 99)), "Opset 99 is under development"),
        (changed(rename), "No Op registered for Fold"),
        (changed(lambda m: m.graph.ClearField("node")), "cannot use the model ("),
    ],
    ids=["IR", "opset", "operator", "no nodes"],
)
def test_the_reason_of_the_library_is_given(world: World, make: Callable[[World], bytes], words: str) -> None:
    text = refused(make(world), world)
    assert words in text and "onnxruntime_src" not in text and "[ONNXRuntimeError]" not in text
    assert f"ONNX Runtime {ort.__version__} cannot use the model" in text


def test_a_reason_is_one_short_line() -> None:
    assert reason(ValueError("[ONNXRuntimeError] : 1 : FAIL : too\n  \x1b[1mbad.\n")) == "too [1mbad"
    assert reason(ValueError("")) == "it gives no reason"
    assert len(reason(ValueError("x " * 5000))) <= 160


def test_any_cut_of_a_policy_is_refused_in_a_sentence(world: World) -> None:
    whole = model_of(world, **linear())
    for end in range(0, len(whole), max(1, len(whole) // 40)):
        try:
            open_model(whole[:end])
        except PolicyError as error:
            assert str(error).isprintable()
        else:
            raise AssertionError(f"{end} of {len(whole)} bytes are a policy")
