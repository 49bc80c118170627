"""ONNX files that somebody may send: no loops, nothing from other files, and a limit to what a graph may take."""

import json

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError
from rlctl.policy.file import PolicyInfo
from rlctl.policy.onnx_policy import OnnxActor, encode
from rlctl.policy.policy import Policy

BOX = {"type": "Box", "low": "-1.0", "high": "1.0", "shape": [4], "dtype": "float32"}
ENV = EnvInfo(observation_space=BOX, action_space=BOX)
INFO = PolicyInfo(algo="ppo", policy="MlpPolicy", env=ENV, spec=EnvSpec("reach"))


@pytest.fixture
def write(tmp_path):
    """Write a file with a graph from `obs` to `action`, four numbers each, and rlctl's description."""

    def written(nodes, initializers=(), description=None, **model):
        ports = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", 4]) for name in ("obs", "action")]
        graph = helper.make_graph(nodes, "policy", ports[:1], ports[1:], list(initializers))
        proto = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8, **model)
        entry = proto.metadata_props.add()
        entry.key, entry.value = "rlctl", description or INFO.model_dump_json()
        path = tmp_path / "policy.onnx"
        path.write_bytes(encode(proto))
        return path

    return written


def node(kind, *inputs, to="action", **attributes):
    return helper.make_node(kind, list(inputs), [to], **attributes)


def constant(name, values):
    return numpy_helper.from_array(np.asarray(values), name)


def refused(path):
    with pytest.raises(ArtifactError) as caught:
        OnnxActor.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message


def test_a_graph_as_it_should_be(write):
    policy = Policy(OnnxActor.load(write([node("Tanh", "obs")])))
    assert policy.predict(np.zeros(4)).tolist() == [0.0] * 4


def test_a_tensor_in_another_file(write, tmp_path):
    (tmp_path / "secret").write_bytes(bytes(16))
    outside = constant("w", np.zeros(4, np.float32))
    outside.ClearField("raw_data")
    outside.data_location = TensorProto.EXTERNAL
    for place in ("secret", "../secret", str(tmp_path / "secret")):
        del outside.external_data[:]
        outside.external_data.add(key="location", value=place)
        assert "one of its tensors is in another file" in refused(write([node("Add", "obs", "w")], [outside]))
    inside = node("Constant", to="c", value=outside)
    assert "one of its tensors is in another file" in refused(write([inside, node("Add", "obs", "c")]))


def test_a_loop_that_never_ends(write):
    ports = [helper.make_tensor_value_info(name, TensorProto.BOOL, []) for name in ("on", "still")]
    step = helper.make_tensor_value_info("step", TensorProto.INT64, [])
    body = helper.make_graph([node("Identity", "on", to="still")], "body", [step, ports[0]], ports[1:])
    loop = helper.make_node("Loop", ["", "always"], [], body=body)
    path = write([loop, node("Tanh", "obs")], [constant("always", np.array(True))])
    assert "it has functions, loops, branches or sparse tensors, which no policy needs" in refused(path)


def test_functions(write):
    function = helper.make_function(
        "mine", "F", ["x"], ["y"], [node("Tanh", "x", to="y")], [helper.make_opsetid("", 17)]
    )
    assert "it has functions, loops, branches or sparse tensors" in refused(
        write([node("Tanh", "obs")], functions=[function])
    )


def test_a_constant_of_a_terabyte(write):
    nodes = [node("ConstantOfShape", "size", to="much"), node("ReduceSum", "much", to="sum"), node("Add", "obs", "sum")]
    message = refused(write(nodes, [constant("size", np.array([2**38]))]))
    assert "the exported policy cannot act: " in message or "damaged, or not an ONNX file" in message


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([node("NoSuchOperator", "obs")], "damaged: onnxruntime "),
        ([node("Tanh", "obs", domain="not.ours")], "damaged: onnxruntime "),
        ([node("Tanh", "obs", to="other")], "damaged: onnxruntime "),
        ([node("Concat", "obs", "obs", axis=1)], "its graph does not fit its description: "),
        ([node("Concat", "obs", "obs", axis=0)], "its graph does not fit its description: "),
        ([node("Log", "obs", to="x"), node("Mul", "x", "x")], "its graph does not fit its description: "),
    ],
)
def test_graphs_that_are_no_policy(nodes, message, write):
    assert message in refused(write(nodes))


def test_a_state_without_measure(write):
    path = write([node("Tanh", "obs")])
    for layers, hidden in ((10**9, 10**9), ("layers", "hidden"), (0, -1)):
        model = onnx.load(path)
        for name in ("state_h", "state_c"):
            shape = [layers, "batch", hidden]
            model.graph.input.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
        other = path.with_name("state.onnx")
        other.write_bytes(encode(model))
        assert "its graph does not fit its description: " in refused(other)


def test_a_description_that_is_none(write):
    tanh = [node("Tanh", "obs")]
    assert "damaged: nested too deeply" in refused(write(tanh, description="[" * 100_000))
    info = json.loads(INFO.model_dump_json())
    info["env"]["observation_space"]["shape"] = [10**12]
    assert "1,000,000,000,000 elements, at most 10,000,000 are supported" in refused(
        write(tanh, description=json.dumps(info))
    )


@pytest.mark.slow
def test_no_bit_of_an_export_changes_unnoticed(write):
    path = write([node("Add", "obs", "w")], [constant("w", np.arange(4, dtype=np.float32))])
    whole = path.read_bytes()
    for place in range(len(whole)):
        content = bytearray(whole)
        content[place] ^= 1
        path.write_bytes(content)
        refused(path)


def test_changed_weights_are_named_as_such(write):
    path = write([node("Add", "obs", "w")], [constant("w", np.ones(4, np.float32))])
    model = onnx.load(path)
    model.graph.initializer[0].CopyFrom(constant("w", np.zeros(4, np.float32)))
    onnx.save(model, path)
    assert refused(path).endswith("its content does not match its sha256")


def test_an_export_without_a_digest(write):
    path = write([node("Tanh", "obs")])
    model = onnx.load(path)
    description = [prop for prop in model.metadata_props if prop.key == "rlctl"]
    del model.metadata_props[:]
    model.metadata_props.extend(description)
    onnx.save(model, path)
    assert refused(path).endswith("its content does not match its sha256")


def test_any_cut_and_any_flipped_byte(write):
    """Whatever is damaged: loaded all the same, or refused in a line."""
    path = write([node("Add", "obs", "w")], [constant("w", np.zeros(4, np.float32))])
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    lines = []
    for _ in range(150):
        content = bytearray(whole[: rng.integers(len(whole))] if rng.random() < 0.3 else whole)
        for place in rng.integers(len(content), size=3) if content else ():
            content[place] ^= 1 << rng.integers(8)
        path.write_bytes(content)
        try:
            OnnxActor.load(path)
        except ArtifactError as error:
            lines.append(str(error))
    assert len(lines) > 75
    assert all(len(line.splitlines()) == 1 for line in lines)
