"""What a policy observes of a task: some of its observations, histories, privileged ones; and what its teacher does."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.environments.teacher_wrapper import TeacherWrapper
from rlctl.environments.wrappers import select_observations
from rlctl.errors import RecipeError
from rlctl.task.env import TaskEnv
from rlctl.task.mirror import Mirror, join_places
from rlctl.task.observation import Observing
from tests.task.test_terms import Clock

STOOL = "tests.task.batches:Stool"


def observe(*names, **history):
    return TaskEnv(Clock(start=1.0), observing=Observing(names, history))


@pytest.mark.pybullet
def test_some_observations_with_other_histories():
    env = observe("clock", clock=2)
    assert env.reset(seed=0)[0].tolist() == [0.0, 1.0, 0.0, 1.0]
    observation = env.step(np.zeros(2))[0]
    angle = 2 * np.pi * Clock.control_dt
    assert observation.tolist() == pytest.approx([0.0, 1.0, np.sin(angle), np.cos(angle)])
    info = describe(env)
    assert (info.observation_sizes, info.observation_history) == ({"clock": 4}, {"clock": 2})
    assert list(info.observation_terms) == ["clock"]
    assert (info.quantity_sizes, info.observation_units) == ({}, {})
    env.close()
    one = observe("place", place=1)
    assert (one.reset(seed=0)[0].tolist(), describe(one).observation_history) == ([-0.5], {})


@pytest.mark.pybullet
@pytest.mark.parametrize(
    ("names", "history", "message"),
    [
        (("clok",), {}, "observe: Clock has no observation 'clok'. Did you mean 'clock'\\? It has: place, clock."),
        ((), {"plase": 2}, "observation_history: Clock has no observation 'plase'. Did you mean 'place'"),
        (("clock",), {"place": 2}, "observation_history: not in observe: 'place'. It has: clock."),
    ],
)
def test_wrong_names(names, history, message):
    with pytest.raises(RecipeError, match=message):
        observe(*names, **history)


def test_one_world_and_many_see_the_same_and_so_do_their_teachers():
    pytest.importorskip("mujoco")
    student = EnvSpec(STOOL, randomize=True, observe=("speeds", "hips", "place"), observation_history={"hips": 3})
    teacher = EnvSpec(STOOL, events={"late_noise": {}}, observe=("hips", "speeds", "goal"))
    env = student.make(teacher=teacher)
    assert describe(env).observation_sizes == {"hips": 6, "speeds": 2, "place": 3}  # in the order of the task
    batch = student.make_worlds(3, teacher)
    seeds, some = [5, 6, 7], np.array([0, 2])
    batch.reset(np.arange(3), seeds)
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 2)).astype(np.float32)
    for action in actions:
        rows = batch.step(np.stack([action, action]), some).observation
    for row, world, seed in zip(rows, some, (5, 7), strict=True):
        env.reset(seed=seed)
        for action in actions:
            observation = env.step(action)[0]
        np.testing.assert_array_equal(row, observation)
        np.testing.assert_array_equal(batch.teacher.seen[world], env.seen)
        body = env.unwrapped.task.body
        np.testing.assert_allclose(env.seen[:2], body.joint_positions[0], rtol=1e-6)
        np.testing.assert_array_equal(env.seen[2:4], observation[6:8])  # with the noise it was trained with
        assert env.seen[4] == np.float32(env.unwrapped.task.goal[0])


def test_the_mirror_image_of_a_history_by_hand():
    declared = {"hips": (2, 1), "roll": (-1,)}
    places = join_places(declared, [("hips", 2), ("hips", 2), ("roll", 1)])
    assert Mirror(places)(np.array([1.0, 2.0, 3.0, 4.0, 5.0])).tolist() == [2.0, 1.0, 4.0, 3.0, -5.0]


class Pointer(gymnasium.Env):
    """Observes two numbers and the number of steps."""

    observation_space = spaces.Box(np.array([-1, -2, 0], np.float32), np.array([1, 2, 9], np.float32))
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return np.array([0.5, -1.5, 0], np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.array([0.5, -1.5, self.steps], np.float32), 0.0, False, False, {}


def test_elements_of_a_plain_environment():
    env = select_observations(Pointer(), ["2", "0"])
    assert env.observation_space == spaces.Box(np.array([-1, 0], np.float32), np.array([1, 9], np.float32))
    assert env.reset()[0].tolist() == [0.5, 0.0]
    with pytest.raises(RecipeError, match="observe: Pointer has no element '3'"):
        select_observations(Pointer(), ["3"])


def test_a_teacher_of_a_plain_environment_has_its_own_wrappers():
    teacher = EnvSpec("teacher", observe=("2",), frame_stack=3)
    env = EnvSpec("student", observe=("0",)).wrap(
        TeacherWrapper(Pointer(), teacher.observing, teacher.event_settings, teacher.wrap)
    )
    assert env.reset()[0].tolist() == [0.5]
    view = env.env
    assert (view.seen.tolist(), view.teacher_space.shape) == ([0, 0, 0], (3,))
    env.step(0)
    assert env.step(0)[0].tolist() == [0.5]
    assert view.seen.tolist() == [0, 1, 2]
    assert env.reset()[0].tolist() == [0.5]
    assert view.seen.tolist() == [0, 0, 0]
