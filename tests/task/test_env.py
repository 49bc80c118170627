"""One step of a task: its arithmetic, its flags, and what it says when something is wrong."""

import math
from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest

from rlctl.errors import RecipeError, TaskError, UsageError
from rlctl.task import Box, Task
from rlctl.task.env import TaskEnv
from tests.task.tasks import Bounded, Buttons, ByName, Plain, Slider


@pytest.fixture
def make():
    """Make environments that are closed at the end."""
    made = []

    def build(task, **options):
        made.append(TaskEnv(task, **options))
        return made[-1]

    yield build
    for env in made:
        env.close()


def test_a_step_by_hand(make):
    env = make(Slider(start=1.0))
    env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(np.array([-0.25, 0.5]))
    # place 1.0 - 0.25 = 0.75; reward -2.0 * 0.75 - 0.5 * |0.5| + 0.0 * 4.0 = -1.75
    assert reward == -1.75
    assert type(reward) is float
    assert info["reward_terms"] == {"distance": -1.5, "effort": -0.25, "seen": 0.0}
    assert info["metrics"] == {"distance": 0.75, "effort": 0.5, "seen": 4.0}
    assert observation.tolist() == [0.75, 1.0, 7.0]
    assert observation.dtype == np.float32
    assert (terminated, truncated, info["is_success"]) == (False, False, False)


def test_terms_are_in_the_order_of_the_weights_and_add_up(make):
    env = make(Slider())
    env.reset(seed=0)
    *_, info = env.step(np.zeros(2))
    assert list(info["metrics"]) == list(info["reward_terms"]) == ["distance", "effort", "seen"]


def test_terms_of_reach_add_up_to_the_reward(make):
    from rlctl_manipulation.reach import Reach

    env = make(Reach())
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(20):
        _, reward, *_, info = env.step(rng.uniform(-1, 1, 7))
        assert reward == sum(info["reward_terms"].values())
        for name, weight in Reach.reward_weights.items():
            assert info["reward_terms"][name] == weight * info["metrics"][name]


def test_weights_of_a_recipe_replace_single_ones(make):
    env = make(Slider(), reward_weights={"effort": -4.0})
    env.reset(seed=0)
    # -2.0 * 1.0 - 4.0 * 0.5 = -4.0
    assert env.step(np.array([0.0, 0.5]))[1] == -4.0
    assert Slider.reward_weights["effort"] == -0.5


def test_success_is_reported(make):
    env = make(Slider(start=0.05))
    env.reset(seed=0)
    assert env.step(np.zeros(2))[4]["is_success"] is True


def test_a_task_without_success_reports_none(make):
    env = make(Plain())
    env.reset(seed=0)
    assert not env.has_success
    assert "is_success" not in env.step(np.zeros(2))[4]


def test_the_time_limit_truncates_and_never_terminates(make):
    env = make(Slider())
    env.reset(seed=0)
    flags = [env.step(np.zeros(2))[2:4] for _ in range(5)]  # 0.5 s of 0.1 s
    assert flags == [(False, False)] * 4 + [(False, True)]


def test_an_end_at_the_time_limit_is_the_tasks_own(make):
    env = make(Slider(start=1.5))
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros(2))
    assert env.step(np.array([1.0, 0.0]))[2:4] == (True, False)  # 2.5 > 2.0


def test_no_step_before_a_reset_or_after_the_end(make):
    env = make(Slider())
    message = r"^Slider: step\(\) before reset\(\), after the episode's end, or after close\(\)$"
    with pytest.raises(TaskError, match=message):
        env.step(np.zeros(2))
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(2))
    with pytest.raises(TaskError, match=message):
        env.step(np.zeros(2))
    env.reset(seed=0)
    env.close()
    with pytest.raises(TaskError, match=message):
        env.step(np.zeros(2))
    with pytest.raises(TaskError, match=r"^Slider: reset\(\) after close\(\); make a new environment$"):
        env.reset(seed=0)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("overflow", "Slider: reward term 'distance' is -inf at step 3"),
        ("nan term", "Slider: reward term 'effort' is nan at step 3"),
        ("missing term", "Slider: reward_weights has 'effort', which rewards() does not return"),
        ("one reward", "Slider: rewards() returned 1.0, not a dict of values by name: {'speed': ...}"),
        (
            "unknown term",
            "Slider: rewards() returns 'efort', which has no weight",
        ),
        ("nan observation", "Slider: observation 'place' is not finite at step 3: [nan]"),
        ("shape", "Slider: observation 'place' has shape (3,) at step 3, (1,) at the first observation"),
    ],
)
def test_a_fault_of_the_task_names_the_offender(make, fault, message):
    env = make(Slider(fault=fault))
    env.reset(seed=0)
    env.step(np.zeros(2))
    env.step(np.zeros(2))
    with pytest.raises(TaskError) as caught:
        env.step(np.zeros(2))
    assert str(caught.value) == message


def test_a_step_that_fails_counts_for_the_time_limit(make):
    env = make(Slider(fault="nan term"))
    env.reset(seed=0)
    for _ in range(2):
        env.step(np.zeros(2))
    with pytest.raises(TaskError):
        env.step(np.zeros(2))
    env.unwrapped.task.fault = ""
    steps = 3
    while not env.step(np.zeros(2))[3]:
        steps += 1
    assert steps + 1 == env.unwrapped.max_steps


def test_a_changed_shape_in_a_dict_layout(make):
    env = make(ByName(fault="shape"))
    env.reset(seed=0)
    env.step(np.zeros(2))
    env.step(np.zeros(2))
    with pytest.raises(TaskError, match=r"observation 'place' has shape \(3,\) at step 3, \(1,\) at the first"):
        env.step(np.zeros(2))


def test_a_forgotten_return(make):
    env = make(Slider())
    env.task.is_success = lambda: None
    env.reset(seed=0)
    with pytest.raises(TaskError, match=r"Slider: is_success\(\) returned None, not True or False"):
        env.step(np.zeros(2))


def test_an_unknown_weight_names_the_closest():
    with pytest.raises(RecipeError) as caught:
        TaskEnv(Slider(), reward_weights={"distence": 1.0})
    assert str(caught.value) == (
        "reward_weights: Slider has no term 'distence'. Did you mean 'distance'? It has: distance, effort, seen."
    )


def test_a_definition_must_not_be_annotated():
    with pytest.raises(TaskError) as caught:

        class Wrong(Task):
            substeps: int = 3

    assert str(caught.value) == (
        "Wrong.substeps is annotated, which would make it a parameter: write `substeps = ...` without the annotation"
    )


def test_the_time_limit_may_be_a_parameter(make):
    @dataclass
    class Patient(Slider):
        episode_s: float = 3.0

    assert make(Slider()).max_steps == 5  # 0.5 s / 0.1 s
    assert make(Patient()).max_steps == 30
    assert make(Patient(episode_s=1.0)).max_steps == 10
    assert list(Patient.parameters()) == ["start", "fault", "episode_s"]


def test_spaces_are_not_shared_between_instances(make):
    first, second = make(Slider()), make(Slider())
    assert first.action_space is not second.action_space
    first.action_space.seed(1)
    second.action_space.seed(1)
    first.action_space.sample()
    Slider.action_space.sample()
    alone = Box(-1.0, 1.0, (2,), np.float32)
    alone.seed(1)
    assert second.action_space.sample().tolist() == alone.sample().tolist()
    assert first.observation_space is not second.observation_space
    assert first.metadata is not second.metadata


def test_actions_are_clipped_to_the_space(make):
    env = make(Slider())
    env.reset(seed=0)
    observation, *_, info = env.step(np.array([-0.5, 80.0]))
    assert info["metrics"]["effort"] == 1.0
    assert env.task.action.dtype == np.float32
    env.step(np.array([-math.inf, 0.0]))
    assert env.task.action.tolist() == [-1.0, 0.0]
    assert observation[0] == 0.5


def test_actions_that_cannot_be_meant(make):
    env = make(Slider())
    env.reset(seed=0)
    with pytest.raises(TaskError, match=r"^Slider: action is not finite at step 1$"):
        env.step(np.array([np.nan, 0.0]))
    with pytest.raises(TaskError, match=r"^Slider: action of shape \(3,\), the space has \(2,\)$"):
        env.step(np.zeros(3))
    buttons = make(Buttons())
    buttons.reset(seed=0)
    buttons.step(1)
    with pytest.raises(TaskError, match=r"^Buttons: action 2 is not in Discrete\(2\)$"):
        buttons.step(2)


def test_dict_layout(make):
    env = make(ByName())
    assert isinstance(env.observation_space, gymnasium.spaces.Dict)
    observation, _ = env.reset(seed=0)
    assert list(observation) == ["place", "counters"]
    assert {key: value.dtype for key, value in observation.items()} == {"place": np.float32, "counters": np.float32}
    assert env.observation_space.contains(observation)
    assert env.observation_sizes == {"place": 1, "counters": 2}


class BoundedByName(Bounded):
    observation_layout = "dict"


def test_observation_bounds_in_a_dict_layout(make):
    env = make(BoundedByName())
    assert env.observation_space["place"].high.tolist() == [1.5]
    env.reset(seed=0)
    observation = env.step(np.array([0.50002, 0.0]))[0]
    assert observation["place"].tolist() == [1.5]
    assert env.observation_space.contains(observation)
    with pytest.raises(TaskError, match=r"^BoundedByName: observation 'place' is 1.75002 at step 2, outside its bou"):
        env.step(np.array([0.25, 0.0]))


def test_observations_are_not_the_tasks_own_arrays(make):
    class Aliased(ByName):
        def reset(self, rng):
            super().reset(rng)
            self.memory = np.zeros(2, np.float32)

        def observe(self):
            return {"place": self.memory}

    env = make(Aliased())
    observation, _ = env.reset(seed=0)
    env.task.memory += 1.0
    assert observation["place"].tolist() == [0.0, 0.0]


def test_observation_bounds(make):
    env = make(Bounded())
    assert env.observation_space.low.tolist() == [-1.0, -math.inf, -math.inf]
    assert env.observation_space.high.tolist() == [1.5, math.inf, math.inf]
    env.reset(seed=0)
    assert env.step(np.array([0.50002, 0.0]))[0][0] == 1.5  # rounding is clipped
    with pytest.raises(TaskError) as caught:
        env.step(np.array([0.25, 0.0]))
    assert str(caught.value) == "Bounded: observation 'place' is 1.75002 at step 2, outside its bounds [-1, 1.5]"


@pytest.mark.parametrize("layout", ["flat", "dict"])
def test_the_observation_farthest_outside_its_bounds_is_named(make, layout):
    class Several(Slider):
        observation_layout = layout
        observation_bounds = {"rounded": (0.0, 1.0), "place": (-1.0, 1.5)}

        def observe(self):
            return {**super().observe(), "rounded": np.array([1.0 + 1e-6])}

    env = make(Several())
    env.reset(seed=0)
    env.step(np.array([0.5, 0.0]))
    with pytest.raises(TaskError, match=r"^Several: observation 'place' is 1\.75"):
        env.step(np.array([0.25, 0.0]))


def test_an_empty_observation_is_named(make):
    class Sliced(Slider):
        def observe(self):
            return {**super().observe(), "swing": np.zeros(2)[2:]}

    with pytest.raises(TaskError, match=r"^Sliced: observation 'swing' is empty: check the slice in observe$"):
        make(Sliced())


def test_bounds_of_what_is_not_observed():
    class Wrong(Slider):
        observation_bounds = {"plase": (0.0, 1.0)}

    with pytest.raises(TaskError) as caught:
        TaskEnv(Wrong())
    assert str(caught.value) == ("Wrong: bounds or units for 'plase', which is not observed. Did you mean 'place'?")


def test_gymnasiums_own_checker_is_content(make):
    from gymnasium.utils.env_checker import check_env

    check_env(make(Bounded(start=0.0)), skip_render_check=True)


@pytest.mark.pybullet
@pytest.mark.parametrize(("display", "why"), [("", "DISPLAY is not set"), (":9876", "no X server answers at :9876")])
def test_a_window_without_a_display_does_not_end_the_process(monkeypatch, display, why):
    monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(UsageError, match=f"PyBullet's window needs a display, and {why}; leave out --gui"):
        TaskEnv(Slider(), render_mode="human")
