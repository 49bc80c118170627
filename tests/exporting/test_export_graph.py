"""The graph does what SB3 does, on random observations and in exact numbers."""

import math

import numpy as np
import onnxruntime
import pytest
from gymnasium import spaces

from rlctl.environments.info import describe
from rlctl.errors import UsageError
from rlctl.exporting.onnx_source import build
from rlctl.policy.file import PolicyFile
from rlctl.policy.onnx_policy import OnnxActor, encode
from rlctl.policy.torch_policy import ACTIVATIONS

ALGORITHMS = ["ppo", "a2c", "sac", "td3", "ddpg", "tqc", "crossq", "xqc", "recurrent_ppo", "dqn"]
ROWS = 50


def session_of(path):
    policy = PolicyFile.read(path)
    model = build(policy)
    return onnxruntime.InferenceSession(model.SerializeToString())


def random_observations(space, rows=ROWS):
    if isinstance(space, spaces.Dict):
        return {key: random_observations(part, rows) for key, part in space.spaces.items()}
    space.seed(0)
    values = np.stack([space.sample() for _ in range(rows)])
    if values.dtype.kind == "f":
        values = (values * [1e-4, 30.0, 1.0] + [0.3, -50.0, 0.1]).astype(values.dtype)
    return values


def difference(model, path, observations):
    """Largest difference between SB3, as it was trained, and the graph from the policy file."""
    env = model.get_vec_normalize_env()
    normal = observations if env is None or not env.norm_obs else env.normalize_obs(observations)
    state = None
    feeds = dict(observations) if isinstance(observations, dict) else {"obs": observations}
    session = session_of(path)
    outputs = [port.name for port in session.get_outputs()]
    if "state_h" in (port.name for port in session.get_inputs()):
        layers, _, hidden = session.get_inputs()[-1].shape
        state = tuple(np.random.default_rng(0).normal(size=(2, layers, ROWS, hidden)).astype(np.float32))
        feeds |= {"state_h": state[0], "state_c": state[1]}
    expected, after = model.policy.predict(normal, state=state, deterministic=True)
    got = dict(zip(outputs, session.run(outputs, feeds), strict=True))
    assert got["action"].shape == expected.shape
    if np.issubdtype(expected.dtype, np.floating) and isinstance(model.action_space, spaces.Box):
        assert got["action"].dtype == expected.dtype
        assert len(np.unique(expected)) > 8  # not everything at the bounds, where nothing would show
    pairs = [(got["action"], expected)]
    if state is not None:
        pairs += [(got["state_h_out"], after[0]), (got["state_c_out"], after[1])]
    return max(float(np.abs(ours - theirs).max()) for ours, theirs in pairs)


def action_for(algo):
    return "discrete" if algo == "dqn" else "box"


@pytest.mark.slow_except("ppo", "recurrent_ppo")
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_algorithm_acts_as_in_sb3_with_hard_normalisation(algo, small, train, write, odd_statistics):
    spec = small(action=action_for(algo))
    model = train(algo, spec)
    odd_statistics(model)
    observations = random_observations(model.observation_space)
    assert difference(model, write(model, algo, spec), observations) <= 2e-6


@pytest.mark.slow_except("ppo-dict", "ppo-image", "dqn-image_first", "ppo-multibinary")
@pytest.mark.parametrize(
    "observation", ["double", "image", "image_first", "discrete", "multidiscrete", "multibinary", "dict"]
)
@pytest.mark.parametrize("algo", ["ppo", "dqn"])
def test_every_kind_of_observation(observation, algo, small, train, write):
    spec = small(observation, action_for(algo))
    model = train(algo, spec, steps=0)
    observations = random_observations(spec.make().observation_space)
    assert difference(model, write(model, algo, spec), observations) <= 1e-5


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("algo", ["sac", "recurrent_ppo"])
def test_dict_observations_with_images_in_other_algorithms(algo, small, train, write):
    spec = small("dict")
    model = train(algo, spec, steps=0)
    observations = random_observations(spec.make().observation_space)
    assert difference(model, write(model, algo, spec), observations) <= 1e-5


@pytest.mark.slow_except(first=3)
@pytest.mark.parametrize("action", ["matrix", "double", "wide", "multidiscrete", "multibinary"])
def test_every_kind_of_action(action, small, train, write):
    spec = small(action=action)
    model = train("ppo", spec)
    assert difference(model, write(model, "ppo", spec), random_observations(model.observation_space)) <= 1e-5


@pytest.mark.slow_except("matrix")
@pytest.mark.parametrize("action", ["matrix", "double"])
def test_squashed_actions_of_other_shapes_and_types(action, small, train, write):
    spec = small(action=action)
    model = train("sac", spec)
    assert difference(model, write(model, "sac", spec), random_observations(model.observation_space)) <= 1e-6


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize("name", ACTIVATIONS)
def test_every_activation(name, small, train, write):
    spec = small()
    model = train("ppo", spec, policy_kwargs={"net_arch": [16, 16], "activation_fn": ACTIVATIONS[name]})
    assert difference(model, write(model, "ppo", spec), random_observations(model.observation_space)) <= 1e-6


@pytest.mark.slow_except("ppo-policy_kwargs1")
@pytest.mark.parametrize(
    ("algo", "policy_kwargs"), [("ppo", {}), ("ppo", {"squash_output": True}), ("a2c", {}), ("sac", {}), ("crossq", {})]
)
def test_state_dependent_exploration_acts_without_its_noise(algo, policy_kwargs, small, train, write):
    spec = small()
    model = train(algo, spec, use_sde=True, policy_kwargs={"net_arch": [16], **policy_kwargs})
    assert difference(model, write(model, algo, spec), random_observations(model.observation_space)) <= 1e-6


@pytest.mark.slow_except("policy_kwargs2")
@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"n_lstm_layers": 2, "lstm_hidden_size": 8},
        {"lstm_hidden_size": 8, "shared_lstm": True, "enable_critic_lstm": False},
        {"lstm_hidden_size": 8, "enable_critic_lstm": False, "lstm_kwargs": {"bias": False}},
    ],
)
def test_recurrent_networks_of_other_shapes(policy_kwargs, small, train, write):
    spec = small()
    model = train("recurrent_ppo", spec, policy_kwargs={"net_arch": [8], **policy_kwargs})
    path = write(model, "recurrent_ppo", spec)
    assert difference(model, path, random_observations(model.observation_space)) <= 1e-6


def test_actor_and_critic_with_features_of_their_own(small, train, write):
    spec = small("image")
    model = train("ppo", spec, steps=0, policy_kwargs={"share_features_extractor": False})
    assert difference(model, write(model, "ppo", spec), random_observations(spec.make().observation_space)) <= 1e-5


def with_one_weight(model, algo, weight, bias):
    """A policy that looks at the first normalised element only, with a weight for each of two actions."""
    head = model.policy.action_net if algo == "ppo" else model.policy.actor.mu
    head.weight.data.zero_()
    head.weight.data[:, 0] = weight
    head.bias.data[:] = bias


def test_normalisation_and_clip_in_numbers(small, train, write, odd_statistics):
    spec = small(action="wide")
    model = train("ppo", spec, steps=0, policy_kwargs={"net_arch": []})
    odd_statistics(model)
    with_one_weight(model, "ppo", 1.0, 0.0)
    session = session_of(write(model, "ppo", spec))
    observations = np.array([[0.3, 0, 0], [0.30002, 0, 0], [0.4, 0, 0], [-5.0, 0, 0]], np.float32)
    actions = session.run(["action"], {"obs": observations})[0][:, 0]
    # (x - 0.3) / sqrt(1e-12 + 1e-8), where x is the nearest float32; clipped to 10.
    deviation = math.sqrt(1e-12 + 1e-8)
    expected = [(float(np.float32(x)) - 0.3) / deviation for x in (0.3, 0.30002)] + [10.0, -10.0]
    assert actions.tolist() == [np.float32(x) for x in expected]
    assert 0.1 < actions[1] < 0.3


def test_bounds_of_an_unsquashed_action_in_numbers(small, train, write, odd_statistics):
    spec = small(action="box")  # from -2 to 1 and from -0.5 to 3
    model = train("ppo", spec, steps=0, policy_kwargs={"net_arch": []})
    odd_statistics(model)
    with_one_weight(model, "ppo", 1.0, 0.0)
    session = session_of(write(model, "ppo", spec))
    observations = np.array([[9.0, 0, 0], [-9.0, 0, 0]], np.float32)  # 10 and -10 when normalised
    assert session.run(["action"], {"obs": observations})[0].tolist() == [[1.0, 3.0], [-2.0, -0.5]]


def test_unscaling_of_a_squashed_action_in_numbers(small, train, write):
    spec = small(action="box")
    model = train("sac", spec, steps=0, policy_kwargs={"net_arch": [4]})
    with_one_weight(model, "sac", 0.0, 0.5)
    session = session_of(write(model, "sac", spec))
    action = session.run(["action"], {"obs": np.zeros((1, 3), np.float32)})[0][0]
    # tanh(0.5) = 0.46212: -2 + 0.73106 * 3 and -0.5 + 0.73106 * 3.5
    assert action.tolist() == pytest.approx([0.19318, 2.05871], abs=1e-5)


def test_file_says_what_it_is(train, tmp_path):
    from rlctl.environments.spec import EnvSpec
    from rlctl.training.snapshot import pack

    spec = EnvSpec("reach", {"tolerance": 0.02})
    model = train("ppo", spec, steps=0)
    policy = pack(model, "ppo", spec, describe(spec.make()))
    info = policy.info
    proto = build(policy)
    assert proto.ir_version == 8
    assert [(entry.domain, entry.version) for entry in proto.opset_import] == [("", 17)]
    metadata = {entry.key: entry.value for entry in proto.metadata_props}
    names = metadata["observation_names"].split(",")
    assert names[0] == "joint_positions"
    assert len(names) == len(metadata["observation_sizes"].split(",")) == len(metadata["observation_units"].split(";"))
    assert metadata["observation_units"].split(";")[0] == "rad"
    assert metadata["action_low"] == ",".join(["-1"] * 7)
    assert metadata["action_high"] == ",".join(["1"] * 7)
    assert metadata["action_meaning"] == info.env.action_meaning
    assert metadata["control_dt"].endswith(" s")
    assert float(metadata["control_dt"].split()[0]) == info.env.control_dt
    assert metadata["training_steps"] == "0"
    assert "stable-baselines3 " in metadata["versions"]
    path = tmp_path / "policy.onnx"
    path.write_bytes(encode(proto))
    assert OnnxActor.load(path).info == info


def test_batch_is_the_only_free_dimension(small, train, write):
    session = session_of(write(train("ppo", small(), steps=0), "ppo", small()))
    assert [(port.name, port.shape) for port in session.get_inputs()] == [("obs", ["batch", 3])]
    assert [(port.name, port.shape) for port in session.get_outputs()] == [("action", ["batch", 2])]


def test_recurrent_state_goes_in_and_out_after_the_action(small, train, write):
    model = train("recurrent_ppo", small(), steps=0, policy_kwargs={"lstm_hidden_size": 8, "n_lstm_layers": 2})
    session = session_of(write(model, "recurrent_ppo", small()))
    state = [2, "batch", 8]
    assert [(port.name, port.shape) for port in session.get_inputs()[1:]] == [("state_h", state), ("state_c", state)]
    assert [port.name for port in session.get_outputs()] == ["action", "state_h_out", "state_c_out"]
    assert session.get_outputs()[1].shape == state


@pytest.mark.parametrize(
    ("observation", "action", "message"),
    [
        ("vector", "integer", "an action of type int32 cannot be written as ONNX"),
        ("taken", "box", "an observation named 'action' cannot be written as ONNX; rename it in the task"),
    ],
)
def test_what_has_no_translation_is_named(observation, action, message, small, train):
    from rlctl.training.snapshot import pack

    spec = small(observation, action)
    model = train("ppo", spec, steps=0)
    policy = pack(model, "ppo", spec, describe(spec.make()))
    with pytest.raises(UsageError, match=message) as raised:
        build(policy)
    assert raised.value.exit_code == 2
