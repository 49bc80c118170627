"""Policies that ship with a plugin: each scores what its metadata says, and what else a user may ask of them."""

import numpy as np
import pytest

import rlctl as package
from rlctl.environments import installed
from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError, RlctlError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import measure_score
from rlctl.exporting.export_request import ExportRequest
from rlctl.exporting.policy_file import export_actor
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.shipped import MeasuredScore, Provenance, find_shipped_policy, list_shipped
from rlctl.recipe.sources import resolve_with_stages
from rlctl.runs.directory import RunDirectory
from rlctl.runs.lookup import find_policy

OURS = [name for name in list_shipped() if installed.find(name).distribution == "rlctl"]


def overlap(one, two):
    return one[0] <= two[1] and two[0] <= one[1]


def check_score(task: str, info: PolicyInfo, episodes: int = 20) -> None:
    """Fail, with what to do, if a shipped policy does not score what its metadata says."""
    provenance = info.provenance
    assert provenance is not None, f"{task}: not written by rlctl export RUN --policy FILE"
    advice = (
        f"Has {task} changed since its policy was shipped? Then train it again and ship what it learns: rlctl train "
        f"{task}; rlctl export {task} --policy {find_shipped_policy(task)}. (If what it scores now is good enough, "
        "measure it anew: the same with --pretrained.) If not, the change is a mistake"
    )
    known = provenance.score
    try:
        measured = measure_score(EvalRequest(task, checkpoint="pretrained", episodes=episodes, seed=known.seed))
    except RlctlError as error:
        pytest.fail(f"{task}: {error}. {advice}")
    for name in ("return_interval", "success_interval"):
        now, before = getattr(measured, name), getattr(known, name)
        if before is not None and (now is None or not overlap(now, before)):
            pytest.fail(f"{task}: {name} is {now} over {episodes} episodes, its metadata has {before}. {advice}")


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize(
    "task", [pytest.param(task, marks=[] if task == "reach" else pytest.mark.slow) for task in OURS]
)
def test_a_shipped_policy_scores_what_its_metadata_says(task):
    check_score(task, PolicyFile.read_info(find_shipped_policy(task)))


@pytest.mark.parametrize("task", OURS)
def test_the_file_of_a_task_is_as_its_policy_was_exported(task):
    """Or each `--pretrained` warns."""
    assert not [note for note in find_policy(task, "pretrained").notes if "warning" in note]


@pytest.mark.pybullet
def test_a_task_that_has_changed_is_noticed():
    info = PolicyFile.read_info(find_shipped_policy("reach"))
    better = info.provenance.score.model_copy(update={"return_interval": (900.0, 901.0)})
    other = info.model_copy(update={"provenance": info.provenance.model_copy(update={"score": better})})
    with pytest.raises(pytest.fail.Exception, match=r"(900.0, 901.0).* Has reach changed .* rlctl export reach"):
        check_score("reach", other, episodes=2)


def test_shipped_policies_are_small_actors_of_installed_tasks():
    files = [find_shipped_policy(task) for task in OURS]
    assert {file.stem for folder in {each.parent for each in files} for file in folder.iterdir()} == set(OURS)
    assert all(file.stat().st_size <= 400_000 for file in files)
    assert sum(file.stat().st_size for file in files) <= 4_000_000
    for task, file in zip(OURS, files, strict=True):
        info = PolicyFile.read_info(file)
        assert info.spec.task == task
        assert info.provenance.baselines.keys() == {"zero", "random"}
        assert info.provenance.score.episodes == 100
        assert info.provenance.recipe["algo"] == info.algo


def test_a_name_loads_the_shipped_policy():
    policy = package.load_policy("reach")
    assert policy.predict(np.zeros(20, np.float32)).shape == (7,)
    with pytest.raises(ArtifactError, match="raech: "):
        package.load_policy("raech")


def test_what_is_not_shipped():
    with pytest.raises(UsageError, match=r"give a task that ships a policy: .*reach"):
        find_shipped_policy(None)
    with pytest.raises(UsageError, match=r"no task 'raech' is installed, .* Did you mean 'reach'\?"):
        find_shipped_policy("raech")


@pytest.mark.slow
@pytest.mark.pybullet
def test_the_actor_of_a_run_and_its_score(tmp_path):
    run = RunDirectory(tmp_path / "reach" / "2026-01-01_00-00-00_s3")
    info = PolicyFile.read_info(find_shipped_policy("reach")).model_copy(update={"provenance": None})
    tensors = PolicyFile.read(find_shipped_policy("reach")).tensors
    PolicyFile(info, {**tensors, "policy/value_net.weight": np.zeros((1, 64), np.float32)}).write(run.best_policy)
    run.write_status({"task": "reach", "git_commit": "abc"})
    run.write_recipe(resolve_with_stages("reach"))
    target = tmp_path / "reach.safetensors"
    exported = export_actor(ExportRequest(str(run.path), checkpoint="best", policy=target, episodes=3))
    policy = PolicyFile.read(target)
    written, actor = policy.info, policy.tensors
    assert actor.keys() == tensors.keys()
    assert written == exported.info
    assert written.provenance.run == "reach/2026-01-01_00-00-00_s3"
    assert written.provenance.git_commit == "abc"
    assert written.provenance.recipe["total_timesteps"] == 120_000
    scores = {"policy": written.provenance.score, **written.provenance.baselines}
    assert all(each.episodes == 3 and each.seed == 0 and each.ended_early == 0.0 for each in scores.values())
    assert scores["zero"].action_change == 0.0
    assert scores["random"].action_change == pytest.approx(2 / 3, abs=0.05)  # two uniform numbers in [-1, 1]
    assert scores["policy"].mean_return > scores["zero"].mean_return
    with pytest.raises(UsageError, match=r"policy.txt: the name of a policy file ends in .safetensors"):
        export_actor(ExportRequest(str(run.path), checkpoint="best", policy=tmp_path / "policy.txt"))
    PolicyFile(info, tensors).write(target)
    with pytest.raises(UsageError, match="the file does not contain the recipe of its training; give its run"):
        export_actor(ExportRequest(str(target), checkpoint="best", policy=tmp_path / "other.safetensors"))
    (tmp_path / "policy.onnx").touch()
    with pytest.raises(
        UsageError, match=r"policy.onnx: the file does not contain the recipe of its training; give its run"
    ):
        export_actor(ExportRequest(str(tmp_path / "policy.onnx"), checkpoint="best", policy=target))


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_shipped_policy_is_measured_anew(tmp_path):
    shipped = PolicyFile.read_info(find_shipped_policy("reach")).provenance
    target = tmp_path / "reach.safetensors"
    for source, checkpoint in (("reach", "pretrained"), (str(target), "best")):  # the second in its own place
        again = export_actor(ExportRequest(source, checkpoint=checkpoint, policy=target, episodes=2)).info.provenance
        assert (again.run, again.recipe, again.git_commit) == (shipped.run, shipped.recipe, shipped.git_commit)
        assert again.source_sha256 == shipped.source_sha256
        assert again.score.episodes == 2
    before, after = (PolicyFile.read(each).tensors for each in (find_shipped_policy("reach"), target))
    assert all((before[name] == after[name]).all() for name in before)
    assert before.keys() == after.keys()


PUSH = """
    import gymnasium, numpy as np
    from gymnasium.spaces import Box

    class Push(gymnasium.Env):
        observation_space, action_space = Box(-1, 1, (2,)), Box(-1, 1, (1,))
        def reset(self, *, seed=None, options=None): return np.zeros(2, np.float32), {}
        def step(self, action): return np.zeros(2, np.float32), 0.0, False, True, {}
"""


def write_push_policy(path, size):
    from gymnasium.spaces import Box

    from rlctl.environments.info import space_to_json
    from rlctl.environments.spec import EnvSpec
    from rlctl.policy.torch_policy import build_network

    spaces = {"observation_space": Box(-1, 1, (size,)), "action_space": Box(-1, 1, (1,))}
    env = EnvInfo(**{name: space_to_json(space) for name, space in spaces.items()})
    score = MeasuredScore(
        episodes=1, seed=0, mean_return=0.0, return_interval=(0.0, 0.0), success=None, success_interval=None,
        mean_length=1.0, ended_early=None, action_change=0.0,
    )  # fmt: skip
    provenance = Provenance(run="push/x", source_sha256="0" * 64, recipe={}, score=score)
    info = PolicyInfo(algo="ppo", policy="MlpPolicy", env=env, spec=EnvSpec("push"), provenance=provenance)
    PolicyFile(info, {f"policy/{k}": v.numpy() for k, v in build_network(info).state_dict().items()}).write(path)


@pytest.mark.slow
def test_a_plugin_ships_a_policy_and_its_task_changes(rlctl, install):
    site = install("pushing", {"push": "pushing:Push"}, {"pushing.py": PUSH})
    none = rlctl("eval", "push", "--pretrained", path=site)
    assert none.returncode == 5
    assert "push ships no policy; train one: rlctl train push. Tasks that ship one: " in none.stderr
    file = site / "policies" / "push.safetensors"
    write_push_policy(file, 2)
    good = rlctl("eval", "push", "--pretrained", "--episodes", 2, path=site)
    assert good.returncode == 0, good.stderr
    assert f"warning: {site}/pushing.py has changed since this policy was exported; its score" in good.stderr
    write_push_policy(file, 3)
    changed = rlctl("eval", "push", "--pretrained", "--episodes", 2, path=site)
    assert changed.returncode == 5
    assert "this policy is not for this task: its observation space is" in changed.stderr
