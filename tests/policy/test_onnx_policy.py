"""Running exported policies: onnxruntime and numpy, nothing else."""

import json
import subprocess
import sys

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from rlctl import load_policy
from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, UsageError
from rlctl.exporting.onnx_source import build
from rlctl.policy.onnx_policy import OnnxActor, encode
from rlctl.policy.torch_policy import ALGORITHMS, policy_name
from rlctl.training.snapshot import pack

PENDULUM = EnvSpec("Pendulum-v1")


def exported(path, algo="ppo", **kwargs):
    env = VecNormalize(DummyVecEnv([PENDULUM.make]))
    env.obs_rms.update(np.array([[0.0, 0.1, -3.0], [0.5, 0.2, 2.0]]))
    model = ALGORITHMS[algo](policy_name(algo, env.observation_space), env, device="cpu", seed=0, **kwargs)
    model.policy.action_net.weight.data.mul_(100.0)  # SB3 begins with actions near zero
    policy = pack(model, algo, PENDULUM, describe(PENDULUM.make()))
    path.write_bytes(encode(build(policy)))
    return path


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    return exported(tmp_path_factory.mktemp("onnx") / "policy.onnx")


@pytest.fixture(scope="module")
def recurrent(tmp_path_factory):
    path = tmp_path_factory.mktemp("onnx") / "policy.onnx"
    return exported(path, "recurrent_ppo", policy_kwargs={"lstm_hidden_size": 8, "n_lstm_layers": 2})


@pytest.fixture
def observations():
    return np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)


def test_one_observation_gets_the_action_that_it_gets_beside_others(pendulum, observations):
    policy = load_policy(pendulum)
    assert isinstance(policy.actor, OnnxActor)
    actions = policy.actor.act_together(observations)
    assert actions.shape == (50, 1)
    assert actions.dtype == np.float32
    alone = np.stack([policy.predict(observation) for observation in observations])
    assert alone.shape == actions.shape
    assert np.abs(alone - actions).max() <= 1e-6
    assert len(np.unique(actions)) > 10


def test_recurrent_policy_remembers_until_reset(recurrent, observations):
    policy = load_policy(recurrent)
    first = [policy.predict(observation) for observation in observations[:3]]
    again = [policy.predict(observation) for observation in observations[:3]]
    assert not np.array_equal(first[0], again[0])
    policy.reset()
    afresh = [policy.predict(observation) for observation in observations[:3]]
    assert np.array_equal(first, afresh)


def test_several_recurrent_episodes_begin_without_a_state(recurrent, observations):
    policy = load_policy(recurrent)
    policy.predict(observations[0])
    actions = policy.actor.act_together(observations)
    policy.reset()
    assert np.abs(policy.predict(observations[5]) - actions[5]).max() <= 1e-6


def test_observation_of_a_wrong_shape(pendulum):
    policy = load_policy(pendulum)
    with pytest.raises(ValueError, match=r"observation of shape \(4,\), the policy expects \(3,\)"):
        policy.predict(np.zeros(4))


def test_sampling_is_refused(pendulum):
    with pytest.raises(UsageError, match="an exported policy cannot sample"):
        load_policy(pendulum).predict(np.zeros(3), deterministic=False)


def test_missing_file(tmp_path):
    with pytest.raises(ArtifactError, match=r"none\.onnx: no such file"):
        OnnxActor.load(tmp_path / "none.onnx")


@pytest.mark.parametrize("content", ["cut", "text", "empty"])
def test_damaged_file(content, pendulum, tmp_path):
    path = tmp_path / "policy.onnx"
    path.write_bytes({"cut": pendulum.read_bytes()[:500], "text": b"not a graph", "empty": b""}[content])
    with pytest.raises(ArtifactError, match=r"policy\.onnx: damaged, or not an ONNX file") as raised:
        OnnxActor.load(path)
    assert raised.value.exit_code == 5


def test_foreign_file(tmp_path):
    ports = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 3]) for name in ("obs", "action")]
    graph = helper.make_graph([helper.make_node("Tanh", ["obs"], ["action"])], "foreign", ports[:1], ports[1:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, tmp_path / "foreign.onnx")
    with pytest.raises(ArtifactError, match=r"foreign\.onnx: an ONNX file of another program: .* rlctl eval TASK"):
        OnnxActor.load(tmp_path / "foreign.onnx")


def with_description(path, target, change):
    model = onnx.load(path)
    entry = next(candidate for candidate in model.metadata_props if candidate.key == "rlctl")
    description = json.loads(entry.value)
    change(description)
    entry.value = json.dumps(description)
    target.write_bytes(encode(model))
    return target


def test_file_of_a_newer_format(pendulum, tmp_path):
    path = with_description(pendulum, tmp_path / "new.onnx", lambda description: description.update(format=99))
    with pytest.raises(ArtifactError, match=r"new\.onnx: policy format 99 is newer .* upgrade rlctl"):
        OnnxActor.load(path)


def test_description_of_another_graph(pendulum, tmp_path):
    def change(description):
        description["env"]["observation_space"].update(shape=[4], low="-1.0", high="1.0")

    path = with_description(pendulum, tmp_path / "other.onnx", change)
    with pytest.raises(ArtifactError, match=r"its graph does not fit its description: no input 'obs' of shape"):
        OnnxActor.load(path)


@pytest.mark.slow
def test_neither_torch_nor_sb3_is_imported(pendulum):
    code = (
        "import sys, numpy, rlctl\n"
        f"action = rlctl.load_policy({str(pendulum)!r}).predict(numpy.zeros(3))\n"
        "print(action.shape, [name for name in ('torch', 'stable_baselines3', 'sb3_contrib', 'pybullet')"
        " if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=250)
    assert done.stdout == "(1,) []\n", done.stderr
