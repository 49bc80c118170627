"""Small policies of other projects, made from rlctl's own walking policy: nothing is downloaded."""

import itertools
from pathlib import Path

import numpy as np
import onnx
import torch
import yaml
from onnx import TensorProto, helper, numpy_helper

from rlctl.importing.foreign.network import ForeignLinear, ForeignNetwork
from rlctl.policy.file import PolicyFile
from rlctl.policy.network import Network
from rlctl.task.deployment import Deployment
from rlctl_locomotion.quadruped import JOINTS

A1 = "a1.urdf"
SHIPPED = Path(__file__).parents[3] / "plugins" / "rlctl_locomotion" / "policies" / "walk.safetensors"
STANCE = [0.0, 0.8, -1.6] * 4  # [rad]


def describe_walk(**changes):
    """Return how rlctl's policy `walk` is deployed, as plain data."""
    return {
        "joints": JOINTS,
        "default_positions": STANCE,
        "action_scale": [0.25] * 12,
        "action_clip": [-4.0, 4.0],
        "stiffness": [35.0] * 12,
        "damping": [1.0] * 12,  # of the controller and of the gears
        "armature": [0.01] * 12,
        "control_dt": 0.02,
        "observations": [
            {"kind": kind}
            for kind in ("gyroscope", "gravity", "command", "joint_positions", "joint_velocities", "last_action")
        ],
        "commands": {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.4, 0.4], "ang_vel_z": [-0.8, 0.8]},
        "start_height": 0.3,
        **changes,
    }


def read_walk():
    """Return the network of rlctl's policy `walk`, for inputs that are not normalised."""
    network = Network(PolicyFile.read(SHIPPED))
    (normalize,) = network.parts[""]
    hidden = [layer for layer in network.trunk if hasattr(layer, "weight")]
    linears = [
        ForeignLinear(layer.weight.astype(float), layer.bias.astype(float)) for layer in (*hidden, network.head[0])
    ]
    scale = 1.0 / np.sqrt(normalize.variance.astype(float) + 1e-8)
    linears[0] = linears[0].standardize(normalize.mean.astype(float), scale)
    return ForeignNetwork(tuple(linears), "tanh")


def expect_as(network, deployment):
    """Return a network that takes what another project's file says, for one that takes what rlctl observes."""
    columns, factors = Deployment(**deployment).find_columns()
    first = network.first
    return network.with_first(ForeignLinear(first.weight[:, columns] / factors, first.bias))


def write_onnx(path, network, *, inputs=None, metadata=None, extra=()):
    """Write a perceptron as an ONNX file."""
    nodes, tensors, value = [], [], "obs"
    for number, linear in enumerate(network.linears):
        if number:
            nodes.append(helper.make_node(network.activation.capitalize(), [value], [f"a{number}"]))
            value = f"a{number}"
        tensors += [
            numpy_helper.from_array(linear.weight.astype(np.float32), f"w{number}"),
            numpy_helper.from_array(linear.bias.astype(np.float32), f"b{number}"),
        ]
        name = "actions" if number == len(network.linears) - 1 and not extra else f"y{number}"
        nodes.append(helper.make_node("Gemm", [value, f"w{number}", f"b{number}"], [name], transB=1))
        value = name
    nodes += extra
    given = inputs or [("obs", [1, network.observation_size])]
    ports = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in given]
    result = helper.make_tensor_value_info("actions", TensorProto.FLOAT, [1, network.action_size])
    graph = helper.make_graph(nodes, "policy", ports, [result], tensors)
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("their.own", 1)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=8)
    helper.set_model_props(model, metadata or {})
    onnx.save(model, str(path))
    return path


def write_yaml(path, content):
    """Write a mapping as YAML."""
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


SCENE = """
<mujoco>
  <worldbody>
    <body name="floor"><geom name="floor" type="plane" size="0 0 1"/></body>
    <body name="base" pos="0 0 0.5">
      <freejoint/>
      <site name="imu"/>
      <body name="trunk">
        <geom name="trunk" type="box" size="0.1 0.1 0.05" mass="1" contype="0" conaffinity="0"/>
        <body name="left" pos="0 0.1 -0.1">
          <joint name="left_hip" axis="0 1 0" range="-1 1"/>
          <geom type="box" size="0.1 0.03 0.05" mass="0.2"/>
        </body>
        <body name="right" pos="0 -0.1 -0.1">
          <joint name="right_hip" axis="0 1 0" range="-1 1"/>
          <geom type="box" size="0.1 0.03 0.05" mass="0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
  <sensor><accelerometer site="imu" name="accelerometer"/></sensor>
  <actuator>
    <position joint="left_hip" kp="20" kv="1"/>
    <position joint="right_hip" kp="20" kv="1"/>
  </actuator>
  <keyframe><key name="home" qpos="0 0 0.2 1 0 0 0 0 0"/></keyframe>
</mujoco>
"""


def write_scene(folder):
    """Write a robot as projects of MuJoCo have theirs: its base has no mass, and the floor is a body of the file."""
    path = folder / "scene.xml"
    path.write_text(SCENE)
    return str(path)


class Exported(torch.nn.Module):
    """A policy as exporters for TorchScript write it: a normaliser, an LSTM if it has one, and a perceptron."""

    def __init__(self, actor, normalizer):
        super().__init__()
        self.actor = actor
        self.normalizer = normalizer

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.actor(self.normalizer(x))


class Concatenated(Exported):
    """A policy that does more than its parts."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.actor(torch.cat([x, x], 1))


class Normalizer(torch.nn.Module):
    """The normaliser of rsl_rl."""

    def __init__(self, mean, std):
        super().__init__()
        self.eps = 0.01
        self.register_buffer("_mean", torch.tensor(mean)[None])
        self.register_buffer("_std", torch.tensor(std)[None])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x - self._mean) / (self._std + self.eps)


def write_torchscript(path, sizes, kind=Exported, activation=torch.nn.ELU):
    """Write a perceptron of layers of these sizes as TorchScript; return the module."""
    torch.manual_seed(0)
    layers = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [torch.nn.Linear(inputs, outputs), activation()]
    mean, std = [0.5] * sizes[0], [2.0] * sizes[0]
    module = kind(torch.nn.Sequential(*layers[:-1]), Normalizer(mean, std))
    torch.jit.script(module).save(str(path))
    return module


def add_clip(path, tables):
    """Add a clip to an ONNX file as whole_body_tracking does: an input that chooses a row, and an output per table."""
    model = onnx.load(path)
    graph = model.graph
    graph.input.append(helper.make_tensor_value_info("time_step", TensorProto.FLOAT, [1, 1]))
    graph.initializer.append(numpy_helper.from_array(np.array([1], np.int64), "axes"))
    graph.node.append(helper.make_node("Squeeze", ["time_step", "axes"], ["flat"]))
    graph.node.append(helper.make_node("Cast", ["flat"], ["row"], to=TensorProto.INT64))
    for name, table in tables.items():
        graph.initializer.append(numpy_helper.from_array(table.astype(np.float32), f"table_{name}"))
        graph.node.append(helper.make_node("Gather", [f"table_{name}", "row"], [name], axis=0))
        graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, *table.shape[1:]]))
    onnx.save(model, path)
    return path
