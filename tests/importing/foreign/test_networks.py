"""Networks of other projects are read as data, act as the originals, and are refused where they cannot."""

import numpy as np
import onnx
import pytest
import torch
from onnx import helper

from rlctl.errors import ArtifactError
from rlctl.importing.foreign.network import ForeignLinear, ForeignNetwork
from rlctl.importing.foreign.onnx_network import compute, read_onnx, step_lstm
from rlctl.importing.foreign.torchscript import read_torchscript_network
from tests.importing.foreign.policies import Concatenated, add_clip, write_onnx, write_torchscript


@pytest.fixture
def network():
    """A perceptron of 5 observations and 2 actions."""
    rng = np.random.default_rng(0)
    sizes = [(4, 5), (2, 4)]
    linears = tuple(ForeignLinear(rng.normal(size=size), rng.normal(size=size[0])) for size in sizes)
    return ForeignNetwork(linears, "elu")


def test_an_onnx_graph_is_read_as_layers(network, tmp_path):
    read, metadata = read_onnx(write_onnx(tmp_path / "a.onnx", network, metadata={"joint_names": "a,b"}))
    assert (read.observation_size, read.action_size, read.activation) == (5, 2, "elu")
    assert metadata == {"joint_names": "a,b"}
    row = np.linspace(-1.0, 1.0, 5)
    assert compute(read, row) == pytest.approx(compute(network, row), abs=1e-6)


def test_the_means_of_a_distribution_are_what_acts(network, tmp_path):
    # Brax's graphs end so: means and standard deviations, of which the first half goes through tanh.
    split = [
        helper.make_node("Split", ["y1"], ["mean", "std"], num_outputs=2, axis=-1),
        helper.make_node("Tanh", ["mean"], ["actions"]),
    ]
    path = write_onnx(tmp_path / "a.onnx", network, extra=split)
    import onnx

    model = onnx.load(path)
    model.opset_import[0].version = 18
    onnx.save(model, path)
    read, _ = read_onnx(path)
    assert (read.action_size, read.ends_with_tanh, read.algo) == (1, True, "td3")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"inputs": [("obs", [1, 5]), ("time_step", [1, 1])]},
            r"2 inputs \(obs, time_step\), expected one: the observation",
        ),
        ({"inputs": [("obs", ["batch", "size"])]}, "the size of its input obs is dynamic"),
        ({"inputs": [("obs", [1, 5, 1])]}, "has 3 axes"),
        ({"extra": [helper.make_node("Fancy", ["y1"], ["actions"], domain="their.own")]}, "custom operator Fancy"),
        ({"extra": [helper.make_node("Softmax", ["y1"], ["actions"])]}, "the operator Softmax"),
        ({"extra": [helper.make_node("Add", ["y1", "y1"], ["actions"])]}, "joins two branches with Add"),
        ({"extra": [helper.make_node("GRU", ["y1", "y1", "y1"], ["actions"])]}, r"hidden states \(GRU\)"),
    ],
)
def test_graphs_that_are_no_perceptron_are_a_line(network, tmp_path, change, message):
    with pytest.raises(ArtifactError, match=message) as raised:
        read_onnx(write_onnx(tmp_path / "a.onnx", network, **change))
    assert "\n" not in str(raised.value)


class RecurrentExporter(torch.nn.Module):
    """A policy with hidden states as rsl_rl and Isaac Lab export it."""

    def __init__(self):
        super().__init__()
        self.rnn = torch.nn.LSTM(5, 8, 1)
        self.actor = torch.nn.Sequential(torch.nn.Linear(8, 4), torch.nn.ELU(), torch.nn.Linear(4, 2))

    def forward(self, obs, h_in, c_in):
        """Normalise, then act."""
        value, (hidden, cell) = self.rnn(((obs - 0.5) / 2.0).unsqueeze(0), (h_in, c_in))
        return self.actor(value.squeeze(0)), hidden, cell


def test_an_onnx_graph_with_hidden_states(tmp_path):
    torch.manual_seed(0)
    module, path = RecurrentExporter(), tmp_path / "a.onnx"
    state = torch.zeros(1, 1, 8)
    given, results = ["obs", "h_in", "c_in"], ["actions", "h_out", "c_out"]
    torch.onnx.export(
        module, (torch.zeros(1, 5), state, state), str(path), input_names=given, output_names=results, dynamo=False
    )
    network, _ = read_onnx(path)
    assert (network.observation_size, network.action_size, network.algo) == (5, 2, "recurrent_ppo")
    own, hidden, cell = np.zeros((2, 8)), state, state
    for row in np.random.default_rng(1).normal(size=(3, 5)):
        own = step_lstm(network.lstm, row, own)
        with torch.no_grad():
            expected, hidden, cell = module(torch.tensor(row[None], dtype=torch.float32), hidden, cell)
        assert compute(network, own[0]) == pytest.approx(expected[0].numpy(), abs=1e-5)


def test_actions_that_depend_on_the_row_of_a_clip(network, tmp_path):
    extra = [helper.make_node("Add", ["y1", "time_step"], ["actions"])]
    path = add_clip(write_onnx(tmp_path / "a.onnx", network, extra=extra), {"joint_pos": np.zeros((3, 2))})
    with pytest.raises(ArtifactError, match="its actions depend on time_step") as raised:
        read_onnx(path)
    assert "\n" not in str(raised.value)


def test_weights_in_a_file_next_to_the_graph(network, tmp_path):
    path = tmp_path / "policy.onnx"
    model = onnx.load(write_onnx(path, network))
    onnx.save(model, path, save_as_external_data=True, location="policy.onnx.data", size_threshold=0)
    assert path.with_name("policy.onnx.data").exists()
    read, _ = read_onnx(path)
    assert read.linears[0].weight == pytest.approx(network.linears[0].weight, abs=1e-6)
    content = path.with_name("policy.onnx.data").read_bytes()
    path.with_name("policy.onnx.data").write_bytes(content[:8])
    with pytest.raises(ArtifactError, match=r"policy\.onnx\.data is too short"):
        read_onnx(path)
    path.with_name("policy.onnx.data").unlink()
    with pytest.raises(ArtifactError, match=r"policy\.onnx\.data: no such file"):
        read_onnx(path)


def test_weights_in_any_other_file_are_not_read(network, tmp_path):
    path = tmp_path / "policy.onnx"
    model = onnx.load(write_onnx(path, network))
    onnx.save(model, path, save_as_external_data=True, location="w.onnx.data", size_threshold=0)
    model = onnx.load(path, load_external_data=False)
    for place in ("/etc/passwd", "../w.onnx.data", "w.npz"):
        model.graph.initializer[0].external_data[0].value = place
        path.write_bytes(model.SerializeToString())
        with pytest.raises(ArtifactError, match=r"only a file NAME\.onnx\.data next to it is read") as raised:
            read_onnx(path)
        assert "\n" not in str(raised.value)


def test_text_is_no_graph(tmp_path):
    file = tmp_path / "a.onnx"
    file.write_text("not a graph")
    with pytest.raises(ArtifactError, match=r"a\.onnx: "):
        read_onnx(file)


def test_torchscript_is_read_without_running_it(tmp_path):
    module = write_torchscript(tmp_path / "a.pt", [5, 8, 2])
    network = read_torchscript_network(tmp_path / "a.pt")
    row = np.linspace(-1.0, 1.0, 5)
    with torch.no_grad():
        expected = module(torch.tensor(row[None], dtype=torch.float32))[0].numpy()
    assert compute(network, row) == pytest.approx(expected, abs=1e-5)


def test_torchscript_with_an_lstm(tmp_path):
    class Recurrent(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.memory = torch.nn.LSTM(5, 8, 1)
            self.actor = torch.nn.Sequential(torch.nn.Linear(8, 4), torch.nn.ELU(), torch.nn.Linear(4, 2))
            self.register_buffer("hidden_state", torch.zeros(1, 1, 8))
            self.register_buffer("cell_state", torch.zeros(1, 1, 8))

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            out, (h, c) = self.memory(x.unsqueeze(0), (self.hidden_state, self.cell_state))
            self.hidden_state[:] = h
            self.cell_state[:] = c
            return self.actor(out.squeeze(0))

    torch.jit.script(Recurrent()).save(str(tmp_path / "a.pt"))
    network = read_torchscript_network(tmp_path / "a.pt")
    assert network.lstm is not None
    assert (network.observation_size, network.lstm.hidden_size, network.algo) == (5, 8, "recurrent_ppo")


def test_torchscript_that_does_more_is_refused_with_the_way_to_onnx(tmp_path):
    write_torchscript(tmp_path / "a.pt", [10, 8, 2], kind=Concatenated)
    with pytest.raises(ArtifactError, match=r"its forward calls cat; .*torch\.onnx\.export"):
        read_torchscript_network(tmp_path / "a.pt")


def write_graph(path, *, skips=False):
    """Write a perceptron as torch.fx makes it of an ONNX file: a graph whose parts are called one after the other."""
    torch.manual_seed(0)
    parts = {"a/0/Gemm": torch.nn.Linear(5, 4), "a/1/Elu": torch.nn.ELU(), "a/2/Gemm": torch.nn.Linear(4, 2)}
    graph = torch.fx.Graph()
    value = graph.placeholder("input_1")
    for name in parts:
        value = graph.call_module(name, (value,))
    if skips:
        value = graph.call_method("neg", (value,))
    graph.output(value)
    module = torch.fx.GraphModule(parts, graph)
    torch.jit.script(module).save(str(path))
    return module


def test_torchscript_of_a_graph_is_a_chain_of_calls(tmp_path):
    module = write_graph(tmp_path / "a.pt")
    row = np.linspace(-1.0, 1.0, 5)
    with torch.no_grad():
        expected = module(torch.tensor(row[None], dtype=torch.float32))[0].numpy()
    assert compute(read_torchscript_network(tmp_path / "a.pt"), row) == pytest.approx(expected, abs=1e-5)
    write_graph(tmp_path / "a.pt", skips=True)
    with pytest.raises(ArtifactError, match="its graph is no chain of layers"):
        read_torchscript_network(tmp_path / "a.pt")


def test_an_estimator_beside_the_perceptron_is_not_played(tmp_path):
    class Estimating(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.actor = torch.nn.Sequential(torch.nn.Linear(8, 2))
            self.estimator = torch.nn.Sequential(torch.nn.Linear(5, 3))

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return self.actor(torch.cat([x, self.estimator(x)], 1))

    torch.jit.script(Estimating()).save(str(tmp_path / "a.pt"))
    with pytest.raises(ArtifactError, match=r"a\.pt: it estimates what it does not observe \(HIMLoco\)") as raised:
        read_torchscript_network(tmp_path / "a.pt")
    assert "torch.onnx.export" not in str(raised.value)


@pytest.mark.parametrize(("name", "read"), [("a.onnx", read_onnx), ("a.pt", read_torchscript_network)])
def test_a_file_of_a_gigabyte_is_not_read(tmp_path, name, read):
    with (tmp_path / name).open("wb") as file:
        file.truncate(10**9)
    with pytest.raises(ArtifactError, match=rf"{name}: .*too large"):
        read(tmp_path / name)


def test_weights_alone_are_no_network(tmp_path):
    torch.save({"actor.0.weight": torch.zeros(2, 5)}, tmp_path / "a.pt")
    with pytest.raises(ArtifactError, match=r"written by torch\.save"):
        read_torchscript_network(tmp_path / "a.pt")


def test_a_layer_for_an_input_in_another_order():
    linear = ForeignLinear(np.array([[1.0, 2.0]]), np.array([0.5]))
    # The layer reads 3 * element 2 and 10 * element 0 of three: 1 * 3 * x[2] + 2 * 10 * x[0].
    taken = linear.take_columns(np.array([2, 0]), np.array([3.0, 10.0]), 3)
    assert taken.weight.tolist() == [[20.0, 0.0, 3.0]]
    # With mean 2 and factor 3: weight * 3 * (x - 2).
    standardized = ForeignLinear(np.array([[1.0]]), np.array([0.5])).standardize(np.array([2.0]), np.array([3.0]))
    assert (standardized.weight.tolist(), standardized.bias.tolist()) == ([[3.0]], [-5.5])
