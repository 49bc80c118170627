"""Observations computed from measured quantities, and histories: by hand, and alike in one world and in many."""

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.environments.info import EnvInfo, describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RecipeError, TaskError
from rlctl.task import Joints, terms
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl.task.rotations import normalize, roll_pitch_yaw, rotate_inverse
from rlctl.task.worlds import TaskWorlds
from tests.task.batches import Stool
from tests.task.tasks import Slider

pytestmark = pytest.mark.pybullet


class Clock(Slider):
    """A slider that observes its place from 2 m, three times, and a clock of 1 s."""

    observation_terms = {"place": terms.Scaled("rail", offset=2.0, scale=[0.5]), "clock": terms.PhaseClock(1.0)}
    observation_history = {"place": 3}
    observation_units = {"rail": "m"}

    def reset(self, rng):
        super().reset(rng)
        self.time = 0.0

    def act(self, action):
        super().act(action)
        self.time += self.control_dt

    def observe(self):
        return {"place": np.array([self.place]), "clock": self.time}


class Zeros(Clock):
    history_start = "zeros"


def test_gravity_has_the_bits_of_a_rotation():
    quaternions = normalize(np.random.default_rng(0).normal(size=(1000, 4)))
    quaternions[:2] = (0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)
    expected = rotate_inverse(quaternions, (0.0, 0.0, -1.0))
    assert terms.Gravity()(quaternions).tobytes() == expected.tobytes()
    assert terms.Gravity()(quaternions[7]).tobytes() == expected[7].tobytes()


def test_terms_by_hand():
    assert terms.Distance("goal", "hand")((np.array([3.0, 4.0, 1.0]), np.array([0.0, 0.0, 1.0]))).tolist() == [5.0]
    assert terms.Displacement("goal", "hand")((np.array([3.0]), np.array([1.0]))).tolist() == [2.0]
    assert terms.Scaled("q", offset=[1.0, 2.0], scale=2.0)(np.array([2.0, 4.0])).tolist() == [2.0, 4.0]
    # A quarter of a turn, and one turn more.
    assert terms.PhaseClock(4.0)(1.0) == pytest.approx([1.0, 0.0], abs=1e-12)
    assert terms.PhaseClock(4.0)(np.array([[5.0], [2.0]])) == pytest.approx(np.array([[1.0, 0.0], [0.0, -1.0]]))


def test_terms_of_other_projects_by_hand():
    clipped = terms.Scaled("q", offset=1.0, clip=(-0.5, 0.5))
    assert clipped(np.array([1.2, 9.0, -9.0])) == pytest.approx([0.2, 0.5, -0.5])
    # Two legs, half a period apart, after a quarter: sines 1 and -1, cosines 0 and 0.
    assert terms.PhaseClock(4.0, offsets=(0.0, 0.5))(1.0) == pytest.approx([1.0, -1.0, 0.0, 0.0], abs=1e-12)
    half = np.sqrt(0.5)
    # A quarter of a turn about x, y, z; and half a turn about z.
    assert terms.Euler()(np.array([half, 0.0, 0.0, half])) == pytest.approx([np.pi / 2, 0.0, 0.0], abs=1e-6)
    assert terms.Euler()(np.array([0.0, np.sin(0.5), 0.0, np.cos(0.5)])) == pytest.approx([0.0, 1.0, 0.0], abs=1e-6)
    assert terms.Euler()(np.array([0.0, 0.0, 1.0, 0.0])) == pytest.approx([0.0, 0.0, np.pi], abs=1e-6)
    with pytest.raises(TaskError, match="clip must be the lowest and the highest"):
        terms.Scaled("q", clip=(1.0,))


def test_the_orientation_of_a_clip_is_seen_from_the_body():
    half = np.sqrt(0.5)
    # The clip is turned by a quarter about z: its x axis is y in the world, its y axis -x.
    term = terms.ClipOrientation([[0.0, 1.0, 0.0, -1.0, 0.0, 0.0]], 0.1, "orientation")
    same = term((np.array([0.0, 0.0, half, half]), np.array([0.0])))
    assert same == pytest.approx([1.0, 0.0, 0.0, 1.0, 0.0, 0.0])  # the first two columns of the identity
    seen = term((np.array([[0.0, 0.0, 0.0, 1.0]]), np.array([[0.0]])))
    # Rows of the matrix of a quarter about z: (0, -1), (1, 0), (0, 0).
    assert seen[0] == pytest.approx([0.0, -1.0, 1.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="rows of 2 numbers"):
        terms.ClipOrientation([[1.0, 0.0]], 0.1, "orientation")((np.zeros(4), np.array([0.0])))


def test_euler_angles_are_those_of_a_rotation():
    for quaternion in normalize(np.random.default_rng(1).normal(size=(50, 4))):
        assert terms.Euler()(quaternion) == pytest.approx(roll_pitch_yaw(quaternion), abs=1e-6)


def test_a_history_begins_with_the_first_value():
    env = TaskEnv(Clock(start=1.0))
    observation, _ = env.reset(seed=0)
    # (1.0 - 2.0) * 0.5 = -0.5, three times; the clock is at its start.
    assert observation.tolist() == [-0.5, -0.5, -0.5, 0.0, 1.0]
    observation = env.step(np.array([0.5, 0.0]))[0]
    assert observation[:3].tolist() == [-0.5, -0.5, -0.25]
    observation = env.step(np.array([0.5, 0.0]))[0]
    assert observation[:3].tolist() == [-0.5, -0.25, 0.0]
    assert env.measured == {"place": np.array([2.0]), "clock": pytest.approx(2 * Clock.control_dt)}
    assert env.reset(seed=0)[0][:3].tolist() == [-0.5, -0.5, -0.5]
    env.close()


def test_a_history_may_begin_with_zeros():
    env = TaskEnv(Zeros(start=1.0))
    assert env.reset(seed=0)[0][:3].tolist() == [0.0, 0.0, -0.5]
    assert env.step(np.array([0.5, 0.0]))[0][:3].tolist() == [0.0, -0.5, -0.25]
    env.close()


def test_a_history_excludes_a_stack_of_frames():
    with pytest.raises(RecipeError, match="frame_stack: the task declares a history of place; set frame_stack: 1"):
        EnvSpec(f"{__file__}:Clock", frame_stack=2).make()


def test_the_description_has_terms_and_history():
    env = TaskEnv(Clock())
    info = describe(env)
    assert EnvInfo.model_validate_json(info.model_dump_json()) == info
    assert info.observation_sizes == {"place": 3, "clock": 2}
    assert info.observation_history == {"place": 3}
    assert info.quantity_sizes == {"rail": 1}
    assert info.observation_terms["place"] == terms.Scaled("rail", offset=(2.0,), scale=(0.5,))
    other = TaskEnv(Zeros())
    assert info.find_difference(describe(other)) == (
        "its observations have a history of place (3) that begins with first, the environment's have "
        "a history of place (3) that begins with zeros"
    )
    env.close()
    other.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observation_terms": {"plase": terms.LastAction()}}, "a term for 'plase', which is not observed"),
        ({"observation_terms": {"place": "gravity"}}, "it must be one of rlctl.task.terms"),
        ({"observation_terms": {"place": terms.Gravity()}}, "does not fit its term .*: a quaternion of 1 elements"),
        ({"observation_terms": {"place": terms.Distance("a", "b")}}, "1 quantities, expected 2"),
        ({"observation_terms": {"place": terms.Scaled("rail", offset=[1.0, 2.0])}}, "2 numbers for 1 elements"),
        ({"observation_history": {"plase": 2}}, "a history for 'plase', which is not observed. Did you mean 'place'"),
        ({"observation_history": {"place": 0}}, "observation_history of 'place' is 0; .* from 1 to 1000"),
        ({"history_start": "last"}, "history_start is 'last'; it must be 'first' or 'zeros'"),
    ],
)
def test_a_wrong_declaration_is_an_error(changes, message):
    wrong = type("Wrong", (Clock,), changes)
    with pytest.raises(TaskError, match=message):
        TaskEnv(wrong())


def test_a_clock_needs_a_period_and_numbers_are_finite():
    with pytest.raises(TaskError, match=r"period_s is 0\.0"):
        terms.PhaseClock(0.0)
    with pytest.raises(TaskError, match=r"Scaled\('q'\).scale must be finite"):
        terms.Scaled("q", scale=np.inf)


def test_joints_say_what_an_action_commands():
    assert Joints(["hip"], action_step=[0.1], measured="joints").command == ("step", (0.1,))
    assert Joints(["hip"]).command == ("", ())
    with pytest.raises(TaskError, match="action_scale and action_torque exclude each other"):
        Joints(["hip"], action_scale=[1.0], action_torque=[1.0])
    with pytest.raises(TaskError, match="action_step needs measured"):
        Joints(["hip"], action_step=[1.0])
    with pytest.raises(TaskError, match="clips_target needs low and high"):
        Joints(["hip"], action_scale=[1.0], clips_target=True)


class StoolWithHistory(Stool):
    """The stool, with noise on what it remembers, and its goal as a quantity."""

    observation_terms = {"height": terms.Displacement("seat", "goal"), "last": terms.LastAction()}
    observation_history = {"hips": 3, "speeds": 2}

    def observe(self):
        return {**super().observe(), "height": (self.body.base_position[:, 2:], self.goal[:, None])}


@pytest.mark.parametrize("start", ["first", "zeros"])
def test_many_worlds_have_the_histories_of_one(start):
    kind = type("Remembering", (StoolWithHistory,), {"history_start": start, "__doc__": "A stool."})
    events = EventSettings(True, {})
    single = TaskEnv(kind(), events=events, sim=MUJOCO)
    batch = TaskWorlds(kind(), 3, events=events, sim=MUJOCO)
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 2)).astype(np.float32)
    rows = [batch.reset(np.arange(3), [5, 6, 7])[1]]
    for step, action in enumerate(actions):
        if step == 3:  # another world begins an episode; this one goes on
            batch.reset(np.array([2]), [9])
        rows.append(batch.step(np.tile(action, (3, 1))).observation[1])
    expected = [single.reset(seed=6)[0], *(single.step(action)[0] for action in actions)]
    assert np.array(rows).tobytes() == np.array(expected).tobytes()
    hips = slice(*np.cumsum([0, *describe(single).observation_sizes.values()])[[2, 3]])
    assert single.observation_sizes["hips"] == 6
    assert expected[3][hips][:4].tolist() == expected[2][hips][2:].tolist()
    single.close()
    batch.close()


def test_reach_and_walk_declare_their_terms():
    from rlctl_locomotion.walk import Walk
    from rlctl_manipulation.reach import Reach

    env = TaskEnv(Reach())
    env.reset(seed=0)
    goal, hand = env.measured["hand_to_goal"]
    assert (goal == env.task.goal).all()
    assert describe(env).quantity_sizes == {"goal": 3, "hand": 3}
    assert hand.shape == (3,)
    env.close()
    env = TaskEnv(Walk())
    observation, _ = env.reset(seed=0)
    assert describe(env).quantity_sizes == {"orientation": 4, "joint_positions": 12}
    assert observation[3:6].tolist() == pytest.approx([0.0, 0.0, -1.0])
    env.close()


def test_the_measured_joints_are_observed():
    class Moving(Slider):
        def describe_joints(self):
            return Joints(["x", "y"], action_step=[1.0, 1.0], measured="plase")

    with pytest.raises(TaskError, match=r"joints: no observation 'plase'\. Did you mean 'place'"):
        TaskEnv(Moving())


def test_a_clip_is_played_back_by_hand():
    rows = [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]
    clip = terms.Playback(rows, 0.1)
    assert (clip.inputs, clip.internal) == ((), "time")
    # 0.14 s is nearest to row 1; before the first row and after the last one it stays.
    assert clip(0.14).tolist() == [3.0, 4.0]
    assert clip(np.array([[-1.0], [0.26], [9.0]])).tolist() == [[1.0, 2.0], [5.0, 6.0], [5.0, 6.0]]
    error = terms.Playback(rows, 0.1, "angles", "clip_time")
    assert (error.inputs, error.internal) == (("angles", "clip_time"), "")
    assert error((np.array([1.0, 1.0]), np.array([0.1]))).tolist() == [-2.0, -3.0]


@pytest.mark.parametrize(
    ("table", "dt", "problem"),
    [
        ([], 0.1, "rows of finite numbers"),
        ([[1.0, np.nan]], 0.1, "rows of finite numbers"),
        ([1.0, 2.0], 0.1, "rows of finite numbers"),
        ([[1.0]], 0.0, "above 0"),
    ],
)
def test_tables_that_cannot_be_played_back(table, dt, problem):
    with pytest.raises(TaskError, match=problem):
        terms.Playback(table, dt)


def test_a_quantity_of_another_size_than_the_rows():
    with pytest.raises(ValueError, match="1 elements, and a row has 2"):
        terms.Playback([[1.0, 2.0]], 0.1, "angles")((np.array([1.0]), np.array([0.0])))
