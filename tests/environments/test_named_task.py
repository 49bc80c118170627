"""A file may name environments; nothing else of this machine is imported or called because a file says so."""

import json
import sys

import numpy as np
import pytest
from safetensors.numpy import load_file, save

from rlctl.environments import named_task
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.launching.train import run_training
from rlctl.play.episode import EpisodeInfo, RecordedEpisode, load_episode, save_episode
from rlctl.policy.file import PolicyFile, compute_digest
from rlctl.runs.train_request import TrainRequest
from rlctl.storage import files
from tests.training.conftest import ENVS, SMALL_PPO

ENV = """
import gymnasium
from gymnasium import spaces

class Mine(gymnasium.Env):
    def __init__(self, size=1):
        self.observation_space = self.action_space = spaces.Box(-1, 1, (size,))

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, True, {}

def make_mine():
    return Mine()

class Outer:
    Inner = Mine
"""


@pytest.mark.parametrize("kind", [named_task.POLICY, named_task.EPISODE, named_task.RUN])
@pytest.mark.parametrize(
    "task",
    [
        "os:system", "posix:system", "builtins:exec", "subprocess:Popen", "subprocess:run", "shutil:rmtree",
        "runpy:run_path", "antigravity:geohash", "numpy:load", "numpy.lib.npyio:load", "torch:load", "yaml:unsafe_load",
        "rlctl.storage.files:write_text", "rlctl.launching.train:run_training", "gymnasium:make", "antigravity:Env-v0",
        "gymnasium.spaces:Box", "os:\0", "sys:modules",
    ],
)  # fmt: skip
def test_functions_and_classes_of_other_things_are_not_called(task, kind):
    with pytest.raises(ArtifactError, match=rf"^{kind} names .* as its task, but .*; not run") as caught:
        EnvSpec(task, {"command": "true", "cmd": "true"}, named_by=kind).make()
    assert len(str(caught.value).splitlines()) == 1
    assert ("--task" in str(caught.value)) == (kind == named_task.POLICY)
    assert "antigravity" not in sys.modules


def test_a_script_is_not_run(write_module, tmp_path):
    mark = tmp_path / "ran"
    script = write_module("deploy.py", f"open({str(mark)!r}, 'w')\ndef wipe(command): raise SystemExit\n")
    for task in (f"{script}:Env", f"{script}:wipe"):
        with pytest.raises(ArtifactError, match="not run"):
            EnvSpec(task, named_by=named_task.POLICY).make()
        if task.endswith("Env"):
            assert not mark.exists()


@pytest.mark.parametrize("name", ["Mine", "make_mine", "Outer.Inner"])
def test_environments_of_the_users_own_are_made(name, write_module):
    file = write_module(f"own_{name.replace('.', '_').lower()}.py", ENV)
    env = EnvSpec(f"{file}:{name}", named_by=named_task.POLICY).make()
    assert env.observation_space.shape == (1,)


@pytest.mark.parametrize("task", ["reach", "Pendulum-v1", f"{ENVS}:Line", "rlctl_manipulation.reach:Reach"])
def test_what_is_installed_is_made(task):
    env = EnvSpec(task, named_by=named_task.EPISODE).make()
    env.reset(seed=0)
    env.close()


@pytest.mark.slow
def test_what_does_not_exist_is_a_usage_error():
    for task in ("reech", "no_such_module:Env", "NoSuchEnv-v0"):
        with pytest.raises(UsageError):
            EnvSpec(task, named_by=named_task.POLICY).make()


REGISTERS = """
import gymnasium

def _make(**keywords):
    from tests.training.faulty_envs import Faulty
    return Faulty(**keywords)

for name in ("Made/Leg", "LegAlone"):
    gymnasium.register(name, lambda **keywords: _make(**keywords))
"""


@pytest.mark.filterwarnings("ignore:.*Overriding environment")
@pytest.mark.parametrize(
    "task", ["made_ids:Made/Leg", "made_ids:LegAlone", "made_ids.py:Made/Leg", "made_ids.py:LegAlone"]
)
def test_an_id_without_a_version_may_be_named(task, tmp_path, monkeypatch):
    (tmp_path / "made_ids.py").write_text(REGISTERS)
    monkeypatch.chdir(tmp_path)
    EnvSpec(task, {"fault": ""}, named_by=named_task.POLICY).make().close()
    EnvSpec(task, {"fault": ""}).make().close()


def test_an_id_of_a_module_without_gymnasium_is_not_imported(tmp_path, monkeypatch):
    mark = tmp_path / "ran"
    (tmp_path / "other_ids.py").write_text(f"open({str(mark)!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    for name in ("Made/Leg", "Leg", "Leg-v0"):
        with pytest.raises(ArtifactError, match="not run"):
            EnvSpec(f"other_ids:{name}", named_by=named_task.POLICY).make()
    assert not mark.exists()


def test_what_registers_an_id_without_a_version_is_named(tmp_path, monkeypatch):
    (tmp_path / "some_ids.py").write_text('import gymnasium\ngymnasium.register("Made/Arm", "some_ids:Arm")')
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"^some_ids registers Made/Arm, .*: write some_ids:Made/Arm$"):
        EnvSpec("Made/Arm").make()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    return run_training(
        TrainRequest(f"{ENVS}:Line", settings={**SMALL_PPO, "total_timesteps": 64}, root=root, check=False)
    ).run


def test_a_policy_that_names_a_function_runs_nothing(run, tmp_path):
    info = PolicyFile.read(run.best_policy).info
    mark = tmp_path / "ran"
    spec = {"task": "os:system", "parameters": {"command": f"touch {mark}"}, "named_by": ""}
    evil = {**json.loads(info.model_dump_json()), "spec": spec}
    path = tmp_path / "evil.safetensors"
    text, tensors = json.dumps(evil), load_file(run.best_policy)
    path.write_bytes(save(tensors, metadata={"rlctl": text, "sha256": compute_digest(text, tensors)}))
    with pytest.raises(ArtifactError, match=r"^a policy file names 'os:system' as its task"):
        run_evaluation(EvalRequest(str(path), episodes=1))
    assert not mark.exists()
    task = f"{ENVS}:Line"
    assert run_evaluation(EvalRequest(str(path), task=task, episodes=1)).episodes


def test_an_episode_that_names_a_function_runs_nothing(tmp_path):
    mark, path = tmp_path / "ran", tmp_path / "000000.npz"
    spec = EnvSpec("os:system", {"command": f"touch {mark}"})
    info = EpisodeInfo(spec=spec, seed=1, total_reward=0.0)
    save_episode(path, RecordedEpisode(np.zeros((1, 1)), np.zeros((2, 1)), np.zeros(1), np.zeros((1, 0)), info))
    with pytest.raises(ArtifactError, match=r"^a recorded episode names 'os:system' as its task"):
        load_episode(path).info.spec.make()
    assert not mark.exists()


def test_a_run_that_names_a_function_runs_nothing(run, tmp_path):
    mark = tmp_path / "ran"
    run.write_status({"task": "os:system"})
    recipe = run.recipe().model_copy(update={"task": {"command": f"touch {mark}"}})
    files.write_sealed(run.recipe_file, recipe.to_yaml())
    with pytest.raises(ArtifactError, match=r"^run.json names 'os:system' as its task"):
        run_training(TrainRequest(resume=str(run.path), settings={"total_timesteps": 256}, force=True, check=False))
    assert not mark.exists()
