"""Networks that a user writes train, act, resume, and export as built-in ones do; mistakes in them are named."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, RecipeError, UsageError
from rlctl.evaluation.evaluate import EvalRequest, run_evaluation
from rlctl.exporting.c_source import write_c
from rlctl.exporting.export import export_policy
from rlctl.exporting.export_request import ExportRequest
from rlctl.exporting.onnx_source import build
from rlctl.policy import own_modules
from rlctl.policy.file import GRAPH, PolicyFile
from rlctl.policy.load import load_policy
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.onnx_policy import OnnxActor, encode
from rlctl.policy.policy import Policy
from rlctl.policy.torch_policy import ALGORITHMS, TorchActor, policy_name
from rlctl.recipe.recipe import NormalizeSettings, validate
from rlctl.replaying.replay import ReplayRequest, run_replay
from rlctl.training.algorithms import wrap_normalize
from rlctl.training.snapshot import pack
from tests.training import own_nets
from tests.training.own_nets import Gated, Wave

NETS = Path(own_nets.__file__)
SMALL = f"{Path(__file__).parent.parent / 'exporting' / 'envs.py'}:Small"
GATED = {"features_extractor_class": f"{NETS}:Gated", "features_extractor_kwargs": {"features_dim": 6}}
TINY = {
    "total_timesteps": 128,
    "n_envs": 2,
    "algo_kwargs": {"n_steps": 32, "batch_size": 32, "n_epochs": 1},
    "eval": {"episodes": 2},
}


@pytest.mark.slow_except("recurrent_ppo-vector-box-own6")
@pytest.mark.parametrize(
    ("algo", "observation", "action", "own"),
    [
        ("ppo", "vector", "box", {"features_extractor_class": Gated, "activation_fn": Wave}),
        ("ppo", "dict", "multidiscrete", {"features_extractor_class": Gated}),
        ("sac", "image", "box", {"features_extractor_class": Gated}),
        ("td3", "vector", "box", {"activation_fn": Wave}),
        ("ppo", "vector", "box", {"activation_fn": torch.nn.PReLU}),
        ("dqn", "discrete", "discrete", {"features_extractor_class": Gated, "activation_fn": Wave}),
        ("recurrent_ppo", "vector", "box", {"features_extractor_class": Gated}),
    ],
)
def test_it_acts_and_exports_as_torch_does(algo, observation, action, own, tmp_path):
    spec = EnvSpec(SMALL, {"observation": observation, "action": action})
    env = wrap_normalize(DummyVecEnv([spec.make]), NormalizeSettings(), 0.99)
    buffer = {} if "ppo" in algo else {"buffer_size": 10}
    kwargs = {"net_arch": [8, 8], **own, **({"lstm_hidden_size": 8} if algo == "recurrent_ppo" else {})}
    name = policy_name(algo, env.observation_space)
    model = ALGORITHMS[algo](name, env, policy_kwargs=kwargs, device="cpu", seed=0, **buffer)
    model.policy.set_training_mode(False)
    policy = pack(model, algo, spec, describe(spec.make()))
    policy.write(tmp_path / "policy.safetensors")
    torch_policy = Policy(TorchActor.load(tmp_path / "policy.safetensors"))
    acting = Policy(NumpyActor(policy.actor_only()))
    (tmp_path / "policy.onnx").write_bytes(encode(build(policy)))
    exported = Policy(OnnxActor.load(tmp_path / "policy.onnx"))
    space = torch_policy.observation_space
    space.seed(0)
    for _ in range(5):
        sample = space.sample()
        expected = torch_policy.predict(sample)
        np.testing.assert_allclose(acting.predict(sample), expected, atol=2e-6)
        np.testing.assert_allclose(exported.predict(sample), expected, atol=2e-6)
    with pytest.raises(UsageError, match=r"^export --c: the [a-z_]+ (Gated|Wave|PReLU) cannot be written as C; use"):
        write_c(policy, "policy")


@pytest.fixture
def trained(train):
    return train("Line", {**TINY, "policy_kwargs": {**GATED, "activation_fn": "torch.nn:Mish", "net_arch": [8]}})


@pytest.mark.slow
def test_whole_way_of_a_policy(trained, train, tmp_path):
    run = trained.run
    policy = PolicyFile.read(run.last_policy)
    described = policy.info.policy_kwargs
    assert described["features_extractor_class"]["class"] == "Gated"
    assert described["features_extractor_class"]["file"] == str(NETS)
    assert len(described["features_extractor_class"]["sha256"]) == 64
    assert described["activation_fn"] == {"class": "Mish", "module": "torch.nn"}
    assert len(run_evaluation(EvalRequest(str(run.path), episodes=3)).episodes) == 3
    (report,) = export_policy(ExportRequest(str(run.path)))
    assert report.agreement.agrees
    assert report.agreement.observations >= 1000
    assert report.closed_loop.agrees
    settings = {**TINY, "policy_kwargs": {**GATED, "activation_fn": "torch.nn:Mish", "net_arch": [8]}}
    began = train("Line", settings, initial_policy=str(run.last_policy)).run
    before, after = policy.weights, PolicyFile.read(began.policy_file("0")).weights
    assert all((after[name] == before[name]).all() for name in before)


@pytest.mark.slow
def test_resume_is_exact(trained, train, resume):
    whole = train("Line", {**trained.recipe.model_dump(by_alias=True), "total_timesteps": 256})
    resumed = resume(trained, total_timesteps=256)
    ours, theirs = (PolicyFile.read(result.run.last_policy).tensors for result in (resumed, whole))
    assert ours.keys() == theirs.keys()
    assert GRAPH in ours
    for name, values in ours.items():
        np.testing.assert_array_equal(values, theirs[name], err_msg=name)


@pytest.mark.slow
def test_a_policy_file_alone_imports_nothing(trained, tmp_path, monkeypatch):
    file, nets = tmp_path / "policy.safetensors", tmp_path / "nets.py"
    shutil.copy(NETS, nets)
    policy = PolicyFile.read(trained.run.last_policy)
    own = {**policy.info.policy_kwargs["features_extractor_class"], "file": str(nets)}
    policy.with_info(policy_kwargs={**policy.info.policy_kwargs, "features_extractor_class": own}).write(file)
    assert np.isfinite(load_policy(file).predict(np.zeros(load_policy(file).observation_space.shape))).all()
    with pytest.raises(ArtifactError, match=r"nets\.py:Gated; a policy file alone never imports it: give the run"):
        TorchActor.load(file)
    monkeypatch.setenv(own_modules.VARIABLE, str(nets))
    TorchActor.load(file)
    nets.write_text(nets.read_text() + "# changed\n")
    with pytest.raises(ArtifactError, match=r"policy\.safetensors: .*which has changed; restore the version of the"):
        TorchActor.load(file)
    nets.unlink()
    with pytest.raises(ArtifactError, match=r"nets\.py:Gated; that file is missing: restore it"):
        TorchActor.load(file)


@pytest.mark.slow
def test_a_policy_is_replayed_without_its_module(train, tmp_path):
    nets = tmp_path / "gone.py"
    shutil.copy(NETS, nets)
    run = train("Line", {**TINY, "policy_kwargs": {"features_extractor_class": f"{nets}:Gated"}}).run
    nets.unlink()
    (episode,) = run_replay(ReplayRequest(str(run.last_policy), output=tmp_path)).episodes
    assert episode.recording.is_file()
    run_replay(ReplayRequest(None, verify=episode.episode)).check()


@pytest.mark.slow
@pytest.mark.parametrize(("key", "name"), [("features_extractor_class", "Gated"), ("policy_class", "OwnActorCritic")])
def test_a_module_that_changed_is_not_resumed(train, resume, tmp_path, key, name):
    nets = tmp_path / "changing.py"
    shutil.copy(NETS, nets)
    result = train("Line", {**TINY, "policy_kwargs": {key: f"{nets}:{name}"}})
    nets.write_text(nets.read_text() + "# changed\n")
    with pytest.raises(
        ArtifactError, match=rf"changing\.py, with {name}, is not the file that it was trained with; restore it"
    ):
        resume(result, total_timesteps=256)


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("name", "problem"),
    [
        (f"{NETS.with_name('none.py')}:Gated", r"_class: .*none\.py:Gated: no file"),
        ("no_such_module:Gated", r"_class: no_such_module:Gated: no module 'no_such_module'"),
        (f"{NETS}:Gatd", r"_class: .*own_nets\.py:Gatd: .*Gatd"),
        (f"{NETS}:function", r"_class: .*: not a class of torch\.nn\.Module"),
        (
            f"{NETS}:WrongShape",
            r"WrongShape .*: features of shape \(2, 3\) for 2 observations; features_dim requires \(2, 8\)",
        ),
        (f"{NETS}:Raises", r"Raises cannot be used: KeyError: 'gate'"),
        (f"{NETS}:Wave", r"ppo cannot be used here: .*Wave"),
    ],
)
def test_what_is_wrong_with_a_class(train, name, problem):
    with pytest.raises(RecipeError, match=problem):
        train("Line", {**TINY, "policy_kwargs": {"features_extractor_class": name}})


OWN_POLICIES = {
    "ppo": ("Line", "OwnActorCritic", {"features_extractor_class": f"{NETS}:Gated"}),
    "sac": ("Line", "OwnSac", {"net_arch": [8]}),
    "td3": ("Line", "OwnTd3", {"net_arch": [8], "activation_fn": "torch.nn:PReLU"}),
    "dqn": ("Discrete", "OwnDqn", {"net_arch": [8]}),
    "recurrent_ppo": ("Line", "OwnRecurrent", {"lstm_hidden_size": 8}),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "algo", ["ppo", *(pytest.param(algo, marks=pytest.mark.slow) for algo in ("sac", "td3", "dqn", "recurrent_ppo"))]
)
def test_an_own_policy_class_trains_resumes_and_exports(train, resume, algo):
    env, name, kwargs = OWN_POLICIES[algo]
    networks = {**kwargs, "policy_class": f"{NETS}:{name}"}
    given = {**TINY, "eval": {"episodes": 2, "every_steps": 64}, "algo": algo, "policy_kwargs": networks}
    if "ppo" not in algo:
        given["algo_kwargs"] = {"learning_starts": 16, "batch_size": 8, "buffer_size": 200}
    first = train(env, {**given, "total_timesteps": 64})
    described = PolicyFile.read_info(first.run.last_policy).policy_kwargs["policy_class"]
    assert described["class"] == name
    assert described["file"] == str(NETS)
    resume(first, total_timesteps=128)
    whole = train(env, given).run
    ours, theirs = (PolicyFile.read(run.last_policy).tensors for run in (first.run, whole))
    assert ours.keys() == theirs.keys()
    (report,) = export_policy(ExportRequest(str(whole.path)))
    assert report.agreement.agrees
    assert report.closed_loop.agrees
    assert all(np.array_equal(ours[key], theirs[key]) for key in ours)


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("OwnDistribution", "cannot be exported as ONNX for acting: it overrides _get_action_dist_from_latent. Change"),
        ("OwnChoice", r"OwnChoice cannot be exported .* it chooses the action .*, its graph"),
        (
            "NoHead",
            r"NoHead cannot be exported as ONNX for acting: .*Change only what is before Stable-Baseli.*action_net",
        ),
        ("PolicyRaises", r"ppo cannot be used here: 'bodies'"),
        ("OwnSac", "OwnSac is not a subclass of ActorCriticPolicy"),
        ("Gated", "Gated is not a subclass of ActorCriticPolicy"),
    ],
)
def test_what_is_wrong_with_a_policy_class(train, tmp_path, name, problem):
    with pytest.raises(RecipeError, match=problem):
        train("Line", {**TINY, "policy_kwargs": {"policy_class": f"{NETS}:{name}"}})
    assert not list((tmp_path / "runs").glob("*"))


@pytest.mark.slow
def test_an_own_activation_of_a_recurrent_policy_is_refused(train):
    given = {**TINY, "algo": "recurrent_ppo", "policy_kwargs": {"activation_fn": "torch.nn:Mish"}}
    with pytest.raises(UsageError, match="a recurrent_ppo network with activation 'Mish' is not supported"):
        train("Line", given)


def test_arguments_are_checked_without_an_own_class():
    with pytest.raises(RecipeError, match=r"features_dimm"):
        validate({"policy_kwargs": {"features_extractor_kwargs": {"features_dimm": 3}}}, "recipe")
    with pytest.raises(
        RecipeError, match=r"features_extractor_class: expected FILE\.py:CLASS or MODULE:CLASS or null, got 'Gated'"
    ):
        validate({"policy_kwargs": {"features_extractor_class": "Gated"}}, "recipe")
    with pytest.raises(RecipeError, match=r"activation_fn"):
        validate({"policy_kwargs": {"activation_fn": "sine"}}, "recipe")


@pytest.mark.slow
def test_a_hostile_graph_is_refused(trained, tmp_path):
    policy = PolicyFile.read(trained.run.last_policy)
    file = tmp_path / "policy.safetensors"
    for graph in (np.zeros(3, np.uint8), policy.tensors[GRAPH][:-20]):
        PolicyFile(policy.info, {**policy.tensors, GRAPH: graph}).write(file)
        with pytest.raises(ArtifactError, match=r"policy\.safetensors: its tensors do not fit its description"):
            load_policy(file)
