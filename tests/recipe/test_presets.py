"""Recipes by name."""

from pathlib import Path

import pytest

from rlctl.errors import ArtifactError
from rlctl.recipe import recipe_files, sources
from rlctl.task.env import TaskEnv
from rlctl_locomotion.biped import Biped
from rlctl_manipulation.gear_arm import GearArm


def test_ppo_as_documents_have_it():
    made = sources.resolve("reach", Path("presets/ppo"), {})
    assert made.algo == "ppo"
    wanted = {"learning_rate": 3e-4, "n_epochs": 10, "gamma": 0.99, "gae_lambda": 0.95, "clip_range": 0.2}
    assert {name: made.algo_kwargs[name] for name in wanted} == wanted
    assert 1024 <= made.algo_kwargs["n_steps"] <= 2048
    assert 64 <= made.algo_kwargs["batch_size"] <= 256
    assert sources.resolve("reach", Path("presets/ppo"), {"n_envs": 4}).n_envs == 4  # --set goes over it


def test_sac():
    assert sources.resolve("reach", Path("presets/sac"), {}).algo == "sac"


def test_the_example_of_the_page_about_mujoco():
    made = sources.resolve("Reacher-v5", Path("presets/reacher-v5"), {})
    assert (made.algo, made.total_timesteps) == ("ppo", 400_000)


def test_a_gymnasium_id_has_the_preset_of_its_name():
    assert sources.resolve("Reacher-v5", None, {}) == sources.resolve("Reacher-v5", Path("presets/reacher-v5"), {})
    assert sources.resolve("Reacher-v5", Path("presets/sac"), {}).algo == "sac"
    assert sources.resolve("Reacher-v4", None, {}) == sources.resolve("Reacher-v5", None, {})  # another version
    assert sources.resolve("Pendulum-v1", None, {}) == sources.resolve("CartPole-v1", None, {})  # nobody's preset


@pytest.mark.parametrize("robot", ["Ant", "HalfCheetah", "Hopper", "Humanoid", "Walker2d"])
def test_gymnasium_s_robots_learn_off_policy(robot):
    for version in ("v4", "v5"):
        made = sources.resolve(f"{robot}-{version}", None, {})
        assert (made.algo in ("xqc", "crossq"), made.n_envs, made.total_timesteps) == (True, 1, 200_000)


def test_a_preset_that_is_not_there():
    with pytest.raises(ArtifactError) as caught:
        sources.resolve("reach", Path("presets/pppo"), {})
    assert str(caught.value) == (
        "no preset 'presets/pppo'. Did you mean 'presets/ppo'? "
        "Presets: presets/ant-v5, presets/biped-ladder, presets/gear-arm-ladder, presets/halfcheetah-v5, "
        "presets/hopper-v5, presets/humanoid-v5, presets/inverteddoublependulum-v5, presets/ppo, presets/pusher-v5, "
        "presets/reacher-v5, presets/sac, presets/swimmer-v5, presets/walker2d-v5, presets/xqc."
    )


def test_a_file_of_that_name_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "presets").mkdir()
    (tmp_path / "presets" / "ppo").write_text("n_envs: 3\n")
    assert recipe_files.find_config(Path("presets/ppo")) == Path("presets/ppo")
    assert sources.resolve("reach", Path("presets/ppo"), {}).n_envs == 3


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(
    ("task", "cls", "preset", "count"),
    [("biped", Biped, "presets/biped-ladder", 4), ("gear-arm", GearArm, "presets/gear-arm-ladder", 4)],
)
def test_the_ladders_can_be_built(task, cls, preset, count):
    stages = sources.resolve(task, Path(preset), {}).stages
    assert len(stages) == count
    for stage in stages:
        env = TaskEnv(cls(**stage.task), reward_weights=stage.reward_weights)
        env.reset(seed=0)
        env.close()
