"""Policy files, and policies that act."""

import contextlib
import dataclasses
import json

import numpy as np
import pytest
from gymnasium import spaces
from safetensors.numpy import load_file, save

import rlctl
from rlctl import load_policy
from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError
from rlctl.policy.file import PolicyFile, PolicyInfo, compute_digest
from rlctl.policy.network import Network
from rlctl.policy.torch_policy import TorchActor, build_network, pin_threads
from rlctl.runs.directory import RunDirectory

BOX = spaces.Box(-np.inf, np.inf, (5,), np.float32)
DICT = spaces.Dict({"a": spaces.Box(-np.inf, np.inf, (3,), np.float32), "b": spaces.Discrete(4)})
ACTIONS = spaces.Box(-1.0, 1.0, (2,), np.float32)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    import torch

    before = torch.get_num_threads()
    pin_threads()
    torch.manual_seed(0)
    yield
    torch.set_num_threads(before)


def describe(algo="ppo", policy="MlpPolicy", observation=BOX, action=ACTIONS, **options):
    env = EnvInfo(observation_space=space_to_json(observation), action_space=space_to_json(action))
    return PolicyInfo(algo=algo, policy=policy, env=env, spec=EnvSpec("my_env.py:MyEnv"), training_steps=7, **options)


def tensors_of(info):
    tensors = {f"policy/{key}": value.numpy() for key, value in build_network(info).state_dict().items()}
    for key in info.normalized_keys:
        tensors[f"normalize/{key}/mean"] = np.linspace(-1, 1, 5)
        tensors[f"normalize/{key}/var"] = np.linspace(0.5, 2, 5)
    return tensors


@pytest.fixture
def saved(tmp_path):
    def save(**options):
        info = describe(**options)
        path = tmp_path / "policy.safetensors"
        PolicyFile(info, tensors_of(info)).write(path)
        return path

    return save


@pytest.fixture
def path(saved):
    return saved(policy_kwargs={"net_arch": [16]}, normalized_keys=[""], clip_observation=10.0)


def test_equal_policies_have_equal_bytes():
    info = describe()
    file = PolicyFile(info, tensors_of(info))
    assert len({file.encode() for _ in range(8)}) == 1


def test_round_trip(tmp_path):
    info = describe(policy_kwargs={"net_arch": [8]})
    tensors = tensors_of(info)
    tensors["policy/transposed"] = np.arange(6.0).reshape(2, 3).T
    path = tmp_path / "policies" / "best.safetensors"
    PolicyFile(info, tensors).write(path)
    policy = PolicyFile.read(path)
    read, arrays = policy.info, policy.tensors
    assert read == info
    assert arrays.keys() == tensors.keys()
    for name, value in tensors.items():
        np.testing.assert_array_equal(arrays[name], value)
        assert arrays[name].dtype == value.dtype


def test_no_bit_of_a_policy_changes_unnoticed(path):
    content = path.read_bytes()
    policy = PolicyFile.read(path)
    info, tensors = policy.info, policy.tensors
    chance, accepted = np.random.default_rng(0), []
    for bit in chance.integers(8 * len(content), size=400).tolist():
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        with contextlib.suppress(ArtifactError):
            accepted.append(PolicyFile.read(path))
    # What is left are bits of the format's own, such as the name of the digest.
    assert len(accepted) < 8
    for now, arrays in accepted:
        assert now == info
        assert {name: values.tobytes() for name, values in arrays.items()} == {
            name: values.tobytes() for name, values in tensors.items()
        }


def test_normalisation_by_hand(path):
    tensors = PolicyFile.read(path).tensors
    observation = np.array([3.0, -2.0, 0.0, 1.0, 90.0], np.float32)
    mean, var = tensors["normalize//mean"], tensors["normalize//var"]
    expected = np.clip((observation - mean) / np.sqrt(var + 1e-8), -10.0, 10.0)
    assert expected[4] == 10.0
    (normalize,) = Network(PolicyFile.read(path)).parts[""]
    rows = observation[None]
    np.testing.assert_array_equal(normalize(rows)[0], expected.astype(np.float32))
    np.testing.assert_array_equal(TorchActor.load(path).normalize(rows)[0], expected.astype(np.float32))


def rewrite(path, metadata):
    tensors = load_file(path)
    digest = {"sha256": compute_digest(metadata["rlctl"], tensors)} if "rlctl" in metadata else {}
    path.write_bytes(save(tensors, metadata={**metadata, **digest}))


@pytest.mark.parametrize("size", [0, 4, 100, -1])
def test_a_truncated_file(path, size):
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(ArtifactError, match=r"policy.safetensors: damaged, or not a .safetensors file: ") as caught:
        rlctl.load_policy(path)
    assert caught.value.exit_code == 5


def test_a_file_of_another_program(path):
    rewrite(path, {"format": "pt"})
    with pytest.raises(ArtifactError) as caught:
        rlctl.load_policy(path)
    assert str(caught.value) == f"{path}: not an rlctl policy: its metadata has no 'rlctl' entry"


def test_a_newer_format(path):
    rewrite(path, {"rlctl": json.dumps({"format": 2, "new": "things"})})
    with pytest.raises(ArtifactError) as caught:
        rlctl.load_policy(path)
    assert str(caught.value) == (
        f"{path}: policy format 2 is newer than this rlctl {rlctl.__version__} can read (1); upgrade rlctl"
    )


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"format": 1, "algo": 3}'])
def test_damaged_metadata(path, text):
    rewrite(path, {"rlctl": text})
    with pytest.raises(ArtifactError, match=r"policy.safetensors: damaged: "):
        rlctl.load_policy(path)


def test_a_policy_without_a_digest(path):
    policy = PolicyFile.read(path)
    info, tensors = policy.info, policy.tensors
    path.write_bytes(save(tensors, metadata={"rlctl": info.model_dump_json()}))
    with pytest.raises(ArtifactError, match=r"damaged: its content does not match its sha256$"):
        rlctl.load_policy(path)


def test_a_missing_file(tmp_path):
    with pytest.raises(ArtifactError, match=r"none.safetensors: no such file$"):
        rlctl.load_policy(tmp_path / "none.safetensors")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policy_kwargs": {"net_arch": [32]}}, "its tensors do not fit its description: Error"),
        ({"policy_kwargs": {"net_arch": "wide"}}, "its tensors do not fit its description: "),
        ({"policy_kwargs": {"activation_fn": "sinus"}}, "its tensors do not fit its description: 'sinus'"),
        ({"normalized_keys": ["x"]}, "its tensors do not fit its description: 'normalize/x/mean'"),
        ({"algo": "alphago"}, "policy for an unknown algorithm 'alphago'"),
        ({"policy": "TransformerPolicy"}, "policy of an unknown kind 'TransformerPolicy' for ppo"),
    ],
)
def test_a_description_that_does_not_fit(path, changes, message):
    info = PolicyFile.read(path).info
    rewrite(path, {"rlctl": info.model_copy(update=changes).model_dump_json()})
    with pytest.raises(ArtifactError) as caught:
        TorchActor.load(path)
    assert message in str(caught.value)


def test_a_recurrent_policy_remembers_until_reset(saved):
    path = saved(algo="recurrent_ppo", policy="MlpLstmPolicy", policy_kwargs={"lstm_hidden_size": 16})
    policy = rlctl.load_policy(path)
    observation = np.ones(5, np.float32)
    first, second = policy.predict(observation), policy.predict(observation)
    assert not np.array_equal(first, second)
    policy.reset()
    np.testing.assert_array_equal(policy.predict(observation), first)
    np.testing.assert_array_equal(policy.predict(observation), second)


def test_predict_is_numpy_in_numpy_out(path):
    policy = rlctl.load_policy(path)
    action = policy.predict(np.zeros(5))
    assert action.shape == (2,)
    assert action.dtype == np.float32
    np.testing.assert_array_equal(policy.predict([0.0] * 5), action)
    assert not np.array_equal(policy.predict(np.zeros(5), deterministic=False), action)
    assert policy.info.training_steps == 7


def test_predict_with_a_wrong_shape(path, saved):
    policy = rlctl.load_policy(path)
    with pytest.raises(ValueError, match=r"^observation of shape \(4,\), the policy expects \(5,\)$"):
        policy.predict(np.zeros(4))
    with pytest.raises(ValueError, match=r"^observation of shape \(1, 5\), the policy expects \(5,\)$"):
        policy.predict(np.zeros((1, 5)))
    by_name = rlctl.load_policy(saved(policy="MultiInputPolicy", observation=DICT))
    with pytest.raises(ValueError, match=r"of shape {'a': \(3,\)}, the policy expects {'a': \(3,\), 'b': "):
        by_name.predict({"a": np.zeros(3)})


def test_a_wrong_shape_names_what_the_recipe_adds(tmp_path):
    info = describe()
    info = info.model_copy(update={"spec": dataclasses.replace(info.spec, frame_stack=4, time_feature=True)})
    PolicyFile(info, tensors_of(info)).write(tmp_path / "policy.safetensors")
    with pytest.raises(ValueError, match=r"\(5,\), including the remaining fraction of the episode and 4 frames; "):
        rlctl.load_policy(tmp_path / "policy.safetensors").predict(np.zeros(4))


def test_predict_with_a_picture_from_0_to_1(saved):
    policy = rlctl.load_policy(saved(policy="CnnPolicy", observation=spaces.Box(0, 255, (36, 40, 3), np.uint8)))
    with pytest.raises(ValueError, match=r"^observation has 0\.5, the policy expects uint8$"):
        policy.predict(np.full((36, 40, 3), 0.5))  # it was all black


@pytest.mark.parametrize("algo", ["ppo", "sac", "td3", "crossq", "xqc", "recurrent_ppo"])
def test_an_actor_alone_acts_as_the_whole_policy(tmp_path, algo):
    info = describe(algo, "MlpLstmPolicy" if algo == "recurrent_ppo" else "MlpPolicy", policy_kwargs={"net_arch": [8]})
    tensors = tensors_of(info)
    actor = dict(PolicyFile(info, tensors).actor_only().tensors)
    assert 0 < len(actor) < len(tensors)
    actions = []
    for name, content in (("whole", tensors), ("actor", actor)):
        PolicyFile(info, content).write(tmp_path / f"{name}.safetensors")
        actions.append(rlctl.load_policy(tmp_path / f"{name}.safetensors").predict(np.linspace(-1, 1, 5, dtype="f4")))
    np.testing.assert_array_equal(*actions)
    del actor[min(name for name in actor if name.endswith(".weight"))]
    PolicyFile(info, actor).write(tmp_path / "part.safetensors")
    with pytest.raises(ArtifactError, match="its tensors do not fit its description: tensors missing: "):
        TorchActor.load(tmp_path / "part.safetensors")


def test_the_folder_of_a_run_is_its_best_policy(path, tmp_path):
    run = tmp_path / "a_run"
    (run / "policies").mkdir(parents=True)
    (run / "run.json").write_text("{}")
    (run / "policies/best.safetensors").write_bytes(path.read_bytes())
    assert load_policy(run).info == load_policy(RunDirectory(run)).info == load_policy(path).info
