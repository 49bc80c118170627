"""The time feature: rl-zoo3's agents observe how much of the episode is left."""

import gymnasium
import numpy as np
import pytest
from sb3_contrib.common.wrappers import TimeFeatureWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, RecipeError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.exporting.export import export_policy
from rlctl.exporting.export_request import ExportRequest
from rlctl.importing.import_model import import_model
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.recipe import recipe
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import ReplayRequest
from tests.evaluation.conftest import ENVS

BLOCK = f"{ENVS}:Block"


@pytest.mark.parametrize("task", [pytest.param(BLOCK, marks=pytest.mark.pybullet), "Pendulum-v1", "reach-sparse"])
def test_it_is_that_of_sb3_contrib(task):
    ours, plain = EnvSpec(task, time_feature=True).make(), EnvSpec(task).make()
    limit = describe(plain).max_steps
    theirs = TimeFeatureWrapper(gymnasium.Wrapper(plain), max_steps=limit)
    ours.action_space.seed(0)
    try:
        for space in ("observation_space", "action_space"):
            assert getattr(ours, space) == getattr(theirs, space)
        pairs = [(ours.reset(seed=1)[0], theirs.reset(seed=1)[0])]
        for _ in range(5):
            action = ours.action_space.sample()
            pairs.append((ours.step(action)[0], theirs.step(action)[0]))
        for mine, other in pairs:
            for key in mine if isinstance(mine, dict) else [...]:
                np.testing.assert_array_equal(mine[key], np.asarray(other[key]).astype(np.float32))
            assert ours.observation_space.contains(mine)
    finally:
        ours.close()
        theirs.close()


@pytest.mark.pybullet
def test_it_has_a_name_and_can_be_stacked():
    env = EnvSpec(BLOCK, time_feature=True, frame_stack=2).make()
    assert describe(env).observation_sizes == {"position": 3, "time_left": 1}
    env.reset(seed=0)
    observation = env.step(np.zeros(1, np.float32))[0]
    env.close()
    # 20 steps: all of the time is left at the reset, 19/20 after the first one.
    assert observation[[3, 7]].tolist() == pytest.approx([1.0, 0.95])


def test_it_is_a_key_of_the_recipe():
    (spec,) = recipe.validate({"time_feature": True, "frame_stack": 3}).env_specs("reach")
    assert spec == EnvSpec("reach", time_feature=True, frame_stack=3)


class Endless(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (f"{__file__}:Endless", "time_feature: Endless has no time limit, so there is no remaining time to observe"),
        ("FrozenLake-v1", "time_feature: only flat observations of real numbers can have it, this task has Discrete"),
    ],
)
def test_where_it_cannot_be(task, message):
    with pytest.raises(RecipeError) as caught:
        EnvSpec(task, time_feature=True).make()
    assert str(caught.value).startswith(message)


def make_for_the_zoo():
    # Theirs puts its space into the environment that it wraps, and a task checks its observations against its own.
    return TimeFeatureWrapper(gymnasium.Wrapper(EnvSpec(BLOCK).make()), max_steps=20)


@pytest.fixture(scope="module")
def zoo_agent(tmp_path_factory):
    """A model trained as rl-zoo3 does, with its time feature and its normalisation."""
    folder = tmp_path_factory.mktemp("zoo")
    env = VecNormalize(DummyVecEnv([make_for_the_zoo]), norm_reward=False)
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, device="cpu", seed=0)
    model.learn(64)
    model.save(folder / "model.zip")
    env.save(str(folder / "vecnormalize.pkl"))
    env.training = False
    statistics, output = folder / "vecnormalize.pkl", folder / "policy.safetensors"
    yield model, env, import_model(folder / "model.zip", BLOCK, normalization=statistics, output=output)
    env.close()


@pytest.mark.slow
@pytest.mark.pybullet
def test_the_zoos_agents_play_as_they_did(zoo_agent):
    model, env, imported = zoo_agent
    assert imported.info.spec.time_feature
    evaluated = run_evaluation(EvalRequest(str(imported.path), episodes=2)).played
    for seed, episode in zip(episode_seeds(0, Stream.EVAL, 2), evaluated, strict=True):
        env.seed(seed)
        observation, total, done = env.reset(), 0.0, [False]
        while not done[0]:
            observation, reward, done, _ = env.step(model.predict(observation, deterministic=True)[0])
            total += float(reward[0])
        assert episode.result.total_reward == pytest.approx(total, rel=1e-5)


@pytest.mark.slow
@pytest.mark.pybullet
def test_export_and_replay_honour_it(zoo_agent, tmp_path):
    _, _, imported = zoo_agent
    # It raises unless the file acts the same in closed loop.
    export_policy(ExportRequest(str(imported.path), ("onnx",), "best", tmp_path / "policy.onnx"))
    (episode,) = run_replay(ReplayRequest(str(tmp_path / "policy.onnx"), output=tmp_path)).episodes
    assert run_replay(ReplayRequest(None, verify=episode.episode)).verification.difference is None


@pytest.mark.pybullet
def test_one_number_more_that_is_not_the_time_is_refused(tmp_path):
    class Wider(gymnasium.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32)

        def observation(self, observation):
            return np.append(observation, 0.0).astype(np.float32)

    model = PPO("MlpPolicy", DummyVecEnv([lambda: Wider(EnvSpec(BLOCK).make())]), device="cpu")
    model.save(tmp_path / "model.zip")
    with pytest.raises(ArtifactError, match=r"it observes Box\(4,\), .* returns Box\(3,\)"):
        import_model(tmp_path / "model.zip", BLOCK, output=tmp_path / "policy.safetensors")
