"""Models of Stable-Baselines3 become policies that act the same, and nothing in the files is run."""

import base64
import copy
import json
import pickle
import sys
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from rlctl import load_policy
from rlctl.environments.spec import EnvChanges, EnvSpec
from rlctl.errors import ArtifactError, UsageError
from rlctl.importing.import_model import import_model
from rlctl.importing.sb3_model import read_model, read_normalization
from rlctl.policy.torch_policy import ALGORITHMS, policy_name

SMALL = f"{Path(__file__).parent.parent / 'exporting' / 'envs.py'}:Small"
ON_POLICY = {
    "ppo": {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
    "a2c": {"n_steps": 16},
    "recurrent_ppo": {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
}
OFF_POLICY = {"learning_starts": 8, "buffer_size": 100, "batch_size": 8}
TINY = {"policy_kwargs": {"net_arch": [8]}}
CASES = [
    ("ppo", "vector", "box", {}),
    ("a2c", "vector", "discrete", {}),
    ("dqn", "vector", "discrete", TINY),
    ("recurrent_ppo", "vector", "box", {"policy_kwargs": {"lstm_hidden_size": 8}}),
]
SLOW_CASES = [
    ("ppo", "vector", "box", {"use_sde": True, "policy_kwargs": {"activation_fn": torch.nn.ReLU, "net_arch": [8]}}),
    ("ppo", "dict", "discrete", {"learning_rate": lambda left: 1e-3 * left}),
    ("sac", "vector", "box", {"policy_kwargs": {"net_arch": {"pi": [8], "qf": [16]}}}),
    ("td3", "vector", "box", TINY),
    ("ddpg", "vector", "box", TINY),
    ("tqc", "vector", "box", {"policy_kwargs": {"n_quantiles": 5, "n_critics": 3, "net_arch": [8]}}),
    ("crossq", "vector", "box", TINY),
]


@pytest.fixture
def save(tmp_path):
    """Train a little and save as SB3 does; return the model, its normalisation, and the request to import them."""

    def saved(algo="ppo", observation="vector", action="box", **kwargs):
        parameters = {"observation": observation, "action": action}
        raw = DummyVecEnv([EnvSpec(SMALL, parameters).make])
        raw.observation_space = copy.deepcopy(raw.observation_space)  # VecNormalize writes into a Dict space
        parts = getattr(raw.observation_space, "spaces", {})
        keys = [key for key, space in parts.items() if space.dtype == np.float32] or None
        env = VecNormalize(raw, norm_reward=False, norm_obs_keys=keys)
        settings = copy.deepcopy({**ON_POLICY.get(algo, OFF_POLICY), **kwargs})  # SB3 writes into policy_kwargs
        model = ALGORITHMS[algo](policy_name(algo, env.observation_space), env, device="cpu", seed=0, **settings)
        model.learn(32)
        model.save(tmp_path / "model.zip")
        env.save(str(tmp_path / "vecnormalize.pkl"))
        env.training = False
        request = {
            "file": tmp_path / "model.zip", "task": SMALL, "normalization": tmp_path / "vecnormalize.pkl",
            "output": tmp_path / "policy.safetensors", "changes": EnvChanges(parameters),
        }  # fmt: skip
        return model, env, request

    return saved


@pytest.mark.slow_except("ppo-vector-box-{}", "dqn-vector-discrete-{'policy_kwargs': {'net_arch':")
@pytest.mark.parametrize(
    ("algo", "observation", "action", "kwargs"),
    [*CASES, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW_CASES)],
    ids=lambda value: str(value)[:30],
)
def test_acts_as_the_model_does(save, algo, observation, action, kwargs):
    model, env, request = save(algo, observation, action, **kwargs)
    imported = import_model(**request)
    assert imported.info.algo == algo
    policy = load_policy(imported.path)
    rng, space = np.random.default_rng(0), policy.observation_space
    space.seed(0)
    observations = [
        rng.normal(0, 3, space.shape).astype(np.float32) if observation == "vector" else space.sample()
        for _ in range(1000)
    ]
    expected = predict(model, env, observations, one_by_one=algo == "recurrent_ppo")
    np.testing.assert_allclose([policy.predict(each) for each in observations], expected, rtol=1e-5, atol=1e-5)


def predict(model, env, observations, *, one_by_one):
    """Return the model's actions; one by one for a model that remembers what it saw."""
    if one_by_one:
        actions, state = [], None
        for step, each in enumerate(map(env.normalize_obs, observations)):
            action, state = model.predict(each, state, np.array([step == 0]), deterministic=True)
            actions.append(action)
        return actions
    first = observations[0]
    together = (
        {key: np.stack([each[key] for each in observations]) for key in first} if isinstance(first, dict) else None
    )
    return model.predict(env.normalize_obs(together or np.stack(observations)), deterministic=True)[0]


def test_nothing_is_unpickled(save, monkeypatch):
    _, _, request = save("ppo", learning_rate=lambda left: 1e-3 * left)
    found = []
    sys.addaudithook(lambda event, arguments: found.append(arguments) if event == "pickle.find_class" else None)
    import_model(**request)
    assert found == []


class Attack:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def edit_data(path, **changes):
    """Write a model's archive anew with other entries of its data."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    data.update(changes)
    members["data"] = json.dumps(data)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def serialized(value):
    return {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(value)).decode()}


def test_a_call_that_is_not_on_the_list_is_refused_and_not_made(save, tmp_path):
    _, _, request = save()
    proof = tmp_path / "proof"
    attack = Attack(Path.touch, proof)
    for key in ("policy_kwargs", "observation_space", "action_space", "policy_class"):
        import_model(**request)
        original = request["file"].read_bytes()
        edit_data(request["file"], **{key: serialized(attack if key != "policy_kwargs" else {"net_arch": attack})})
        with pytest.raises(ArtifactError, match="it has data that cannot be imported"):
            import_model(**request)
        request["file"].write_bytes(original)
    edit_data(request["file"], unknown=serialized(attack))
    import_model(**request)  # what is not needed is not looked at
    request["normalization"].write_bytes(pickle.dumps(attack))
    with pytest.raises(ArtifactError, match=r"vecnormalize.pkl: it has data that cannot be imported"):
        import_model(**request)
    assert not proof.exists()


@pytest.mark.slow
def test_a_device_is_not_needed(save):
    _, _, request = save("sac")
    original = import_model(**request)
    for kwargs in ({"device": torch.device("cuda", 1)}, {"device": torch.device("cpu"), "log_std_init": -2}):
        edit_data(request["file"], policy_kwargs=serialized(kwargs), device=serialized(torch.device("cuda")))
        imported = import_model(**request)
        assert "device" not in imported.info.policy_kwargs
        for name, values in original.tensors.items():
            np.testing.assert_array_equal(imported.tensors[name], values)


def test_other_files_are_refused(save, tmp_path, monkeypatch):
    _, _, request = save()
    for name, content in {
        "text.zip": b"not an archive",
        "empty.zip": b"",
        "half.zip": request["file"].read_bytes()[:500],
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ArtifactError, match=name):
            read_model(tmp_path / name)
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        archive.writestr("one.jpg", "x")
    with pytest.raises(ArtifactError, match=r"no file 'data' in the archive; it has one.jpg"):
        read_model(tmp_path / "photos.zip")
    with pytest.raises(ArtifactError, match="no such file"):
        read_model(tmp_path / "nothing.zip")
    (tmp_path / "half.pkl").write_bytes(request["normalization"].read_bytes()[:200])
    with pytest.raises(ArtifactError, match=r"half\.pkl"):
        read_normalization(tmp_path / "half.pkl")
    (tmp_path / "observations.pkl").write_bytes(pickle.dumps([np.zeros(3)] * 1000))
    with pytest.raises(ArtifactError, match=r"observations\.pkl") as caught:
        read_normalization(tmp_path / "observations.pkl")
    assert len(str(caught.value)) < len(str(tmp_path)) + 300  # not all that is in it
    with pytest.raises(UsageError, match=r"--output policy: the name of a policy file ends in \.safetensors"):
        import_model(tmp_path / "nothing.zip", "reach", output=Path("policy"))
    monkeypatch.chdir(tmp_path)
    Path("best_model.safetensors").write_bytes(b"of another")
    with pytest.raises(UsageError, match=r"best_model\.safetensors exists already; give another name: --output FILE"):
        import_model(Path("agents/best_model.zip"), "reach")


def damage_archive(path, encrypted):
    """Mark all members as encrypted, or change a byte in the middle of what is packed."""
    content = bytearray(path.read_bytes())
    if encrypted:
        for signature, offset in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
            start = content.find(signature)
            while start >= 0:
                content[start + offset] |= 1
                start = content.find(signature, start + 4)
    else:
        content[content.find(b"policy.pth") + 200] ^= 0xFF
    path.write_bytes(content)


@pytest.mark.parametrize(("encrypted", "reason"), [(True, "is encrypted"), (False, "Bad CRC-32 for file 'policy.pth'")])
def test_a_damaged_or_encrypted_archive(save, tmp_path, encrypted, reason):
    _, _, request = save()
    path = tmp_path / "model.zip"
    path.write_bytes(request["file"].read_bytes())
    damage_archive(path, encrypted)
    with pytest.raises(ArtifactError, match=rf"model\.zip: not a model of Stable-Baselines3, or damaged: .*{reason}"):
        read_model(path)


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w") as archive:
        archive.writestr("data", b" ")
        archive.filelist[0].file_size = 600_000_000  # written into the archive's table when it is closed
    with pytest.raises(ArtifactError, match="600,000,000 bytes"):
        read_model(tmp_path / "bomb.zip")


def test_a_stack_of_frames_is_named_as_such(tmp_path):
    env = VecFrameStack(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]), 3)
    PPO("MlpPolicy", env, device="cpu").save(tmp_path / "model.zip")
    with pytest.raises(ArtifactError, match=r"Box\(9,\), Pendulum-v1 returns Box\(3,\). Models with VecFrameStack"):
        import_model(tmp_path / "model.zip", "Pendulum-v1")


@pytest.mark.slow
def test_other_spaces_are_refused(save):
    _, _, request = save()
    with pytest.raises(ArtifactError, match=r"model.zip: it observes Box\(3,\), reach returns Box"):
        import_model(request["file"], "reach", normalization=request["normalization"])
    discrete = EnvChanges({"observation": "vector", "action": "discrete"})
    with pytest.raises(ArtifactError, match="its action space is Box"):
        import_model(request["file"], SMALL, changes=discrete)
    with pytest.raises(UsageError, match="--algo pppo"):
        import_model(request["file"], SMALL, algo="pppo")
    with pytest.raises(UsageError, match=r"--algo sac: .*model\.zip is a ppo model"):
        import_model(request["file"], SMALL, algo="sac")
    _, other, _ = save(observation="dict")
    other.save(str(request["normalization"]))
    PPO("MlpPolicy", "Pendulum-v1", device="cpu").save(request["file"])
    with pytest.raises(ArtifactError, match=r"model\.zip with .*vecnormalize\.pkl: "):
        import_model(request["file"], "Pendulum-v1", normalization=request["normalization"], output=request["output"])


def test_a_model_with_a_normalisation_near_it_is_not_imported_without_an_answer(save, rlctl):
    """Without its normalisation a policy acts badly, and its file does not show why."""
    _, _, request = save("ppo")
    folder, model = request["file"].parent, request["file"]
    (folder / "other.pkl").write_bytes(pickle.dumps([1, 2]))
    (folder / "damaged.pkl").write_bytes(b"no pickle")
    statistics = folder / "vecnormalize.pkl"
    command = ["runs", "import", str(model), "--task", SMALL, "-o", str(folder / "policy.safetensors")]
    command += ["--set", "task.observation=vector", "--set", "task.action=box"]
    refused = rlctl(*command)
    assert refused.returncode == 2
    assert not (folder / "policy.safetensors").exists()
    advice = f"--vecnormalize {statistics}"
    assert f"add {advice}; otherwise --vecnormalize none" in refused.stderr
    advised = rlctl(*command, *advice.split())
    assert advised.returncode == 0, advised.stderr
    assert "with observation normalisation" in advised.stdout
    answered = rlctl(*command, "--vecnormalize", "none")
    assert answered.returncode == 0, answered.stderr
    assert "without observation normalisation" in answered.stdout
