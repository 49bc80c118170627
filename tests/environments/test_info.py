"""Spaces as plain data, and back."""

import json

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

import rlctl
from rlctl.environments.info import EnvInfo, describe, space_from_json, space_to_json
from rlctl.errors import ArtifactError, TaskError, UsageError


def test_a_limit_that_is_no_number_of_steps():
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.spec.max_episode_steps = 20.5
    with pytest.raises(TaskError, match=r"^PendulumEnv.max_steps: expected a whole number or null, got 20.5$"):
        describe(env)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1.0, 1.0, (3,), np.float32),
        spaces.Box(np.array([-np.inf, 0.1]), np.array([np.inf, 0.3]), dtype=np.float64),
        spaces.Box(np.array([-1.0, -2.5], np.float32), np.array([0.1, 7.0], np.float32)),
        spaces.Box(0, 255, (8, 6, 3), np.uint8),
        spaces.Box(-5, 5, (2, 2), np.int64),
        spaces.Box(-(2**63), 2**63 - 1, (2,), np.int64),
        spaces.Box(np.array([0, 2**53]), np.array([2**53 + 1, 2**62 + 1]), dtype=np.int64),
        spaces.Box(0, 2**64 - 1, (2,), np.uint64),
        spaces.Box(-1.0, 1.0, (), np.float32),
        spaces.Discrete(5),
        spaces.Discrete(5, start=-2),
        spaces.MultiDiscrete([3, 4, 2]),
        spaces.MultiBinary(4),
        spaces.MultiBinary([2, 3]),
        spaces.Dict(
            {"z": spaces.Discrete(2), "a": spaces.Box(0, 1, (2,)), "n": spaces.Dict({"b": spaces.Discrete(3)})}
        ),
    ],
    ids=str,
)
def test_round_trip(space):
    back = space_from_json(json.loads(json.dumps(space_to_json(space))))
    assert back == space
    assert back.dtype == space.dtype
    if isinstance(space, spaces.Dict):
        assert list(back.spaces) == list(space.spaces)


def test_bounds_keep_every_bit():
    low = np.array([0.1, 1 / 3, 1e-45], np.float32)
    back = space_from_json(space_to_json(spaces.Box(low, low + 1)))
    assert back.low.tobytes() == low.tobytes()


def test_images_take_no_room():
    assert len(json.dumps(space_to_json(spaces.Box(0, 255, (84, 84, 4), np.uint8)))) < 200


@pytest.mark.parametrize(
    ("space", "text"), [(spaces.Text(4), "Text(1, 4, "), (spaces.MultiDiscrete([[2, 3]]), "MultiDiscrete([[2 3]])")]
)
def test_a_kind_no_policy_can_handle(space, text):
    with pytest.raises(UsageError) as caught:
        space_to_json(space)
    assert str(caught.value).startswith(f"the space {text}")
    assert str(caught.value).endswith(
        " is not supported; Box, Discrete, MultiDiscrete of one axis, MultiBinary, Dict are"
    )


@pytest.mark.parametrize(
    "data",
    [{}, {"type": "Sphere"}, {"type": "Box", "low": "0"}, {"type": "Discrete", "n": "many", "start": 0}],
)
def test_what_is_no_space(data):
    with pytest.raises(ArtifactError, match=r"^not a space: "):
        space_from_json(data)


def test_a_task_is_described_with_its_names():
    env = rlctl.make("reach")
    info = describe(env)
    task = env.unwrapped.task
    assert [*info.observation_sizes.items()] == [
        ("joint_positions", 7),
        ("joint_velocities", 7),
        ("hand", 3),
        ("hand_to_goal", 3),
    ]
    assert info.observation_units["joint_positions"] == "rad"
    assert info.spaces() == (env.observation_space, env.action_space)
    assert info.control_dt == task.control_dt
    assert info.command_ranges["goal_z"] == (task.goal_low[2], task.goal_high[2])
    assert info.max_steps == task.max_steps
    assert info.has_success
    assert list(info.reward_weights) == list(task.reward_weights)
    assert EnvInfo.model_validate_json(info.model_dump_json()) == info
    env.close()


def test_a_plain_environment_is_described_as_far_as_possible():
    info = describe(rlctl.make("Pendulum-v1"))
    assert info.observation_space["shape"] == [3]
    assert info.max_steps == 200
    assert not info.has_success
    assert info.control_dt is None


def test_differences_are_described():
    def info(observation, action):
        return EnvInfo(observation_space=space_to_json(observation), action_space=space_to_json(action))

    box, wide = spaces.Box(-1.0, 1.0, (2,)), spaces.Box(-1.0, 1.0, (3,))
    assert info(box, box).find_difference(info(box, box)) is None
    assert info(box, box).find_difference(info(wide, box)) == (
        "its observation space is Box(-1.0, 1.0, (2,), float32), the environment's is Box(-1.0, 1.0, (3,), float32)"
    )
    assert info(box, box).find_difference(info(box, spaces.Discrete(2))) == (
        "its action space is Box(-1.0, 1.0, (2,), float32), the environment's is Discrete(2)"
    )


def test_the_order_of_the_observations_counts():
    box = space_to_json(spaces.Box(-1.0, 1.0, (4,)))
    one, other, renamed = (
        EnvInfo(observation_space=box, action_space=box, observation_sizes=dict.fromkeys(names, 2))
        for names in (("position", "speed"), ("speed", "position"), ("place", "speed"))
    )
    assert one.find_difference(other) == (
        "its observations are in the order position, speed, the environment's in the order speed, position"
    )
    assert one.find_difference(renamed) is None


def test_what_got_another_meaning_in_equal_spaces():
    box = space_to_json(spaces.Box(-1, 1, (3,)))
    common = {"observation_space": box, "action_space": box}
    one = EnvInfo(
        **common, observation_sizes={"angle": 1, "last": 2}, observation_units={"angle": "rad"}, action_meaning="a"
    )
    assert one.list_other_meanings(one) == []
    new = {"observation_sizes": {"angle": 1, "target": 2}, "observation_units": {"angle": "deg"}, "action_meaning": "b"}
    assert one.list_other_meanings(EnvInfo(**common, **new)) == [
        "target was last",
        "angle is in deg, and was in rad",
        "actions are 'b', and were 'a'",
    ]
    split = EnvInfo(**common, observation_sizes={"angle": 1, "speed": 1, "last": 1})
    assert one.list_other_meanings(split) == ["the observations are angle, speed, last, and were angle, last"]
