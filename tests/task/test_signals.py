"""Noise and delay: what the policy sees and what the motors get, and that all of it comes from the seed."""

import numpy as np
import pytest

from rlctl.errors import RecipeError, TaskError
from rlctl.task import Box, Event, Sim, Task, events
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from tests.task.tasks import Buttons, Slider


class Clock(Task):
    """Observes its step, and keeps what its motors got."""

    control_dt, substeps, episode_s = 0.1, 1, 1.0
    action_space = Box(-1.0, 1.0, (2,), np.float32)
    observation_units = {"time": "s", "angle": "rad"}
    reward_weights = {"effort": 1.0}
    events = {
        "late_time": Event("observation", events.delay, of="time", steps=(2, 2)),
        "noisy_angle": Event("observation", events.noise, of=["angle"], std=(0.1, 0.2)),  # [rad]
        "late_action": Event("action", events.delay, steps=(1, 3)),
        "noisy_action": Event("action", events.noise, std=(0.05, 0.1)),
    }

    def build(self, sim: Sim) -> None:
        self.seen = np.zeros(1)

    def reset(self, rng):
        self.start = rng.random()
        self.seen[0] = 10.0
        self.got = []

    def act(self, action):
        self.got.append(action)
        self.seen += 1.0  # in place: a delay must not see it

    def observe(self):
        return {"time": self.seen, "angle": np.zeros(3), "start": np.array([self.start])}

    def rewards(self, action):
        return {"effort": float(action[0])}


class ByName(Clock):
    observation_layout = "dict"


def play(env, seed=0, steps=10):
    """Observations, shape (steps + 1, ...), of an episode whose k-th action is k / 10."""
    rows = [env.reset(seed=seed)[0]]
    rows += [env.step(np.full(2, k / 10))[0] for k in range(1, steps + 1)]
    return np.array(rows)


def test_nothing_is_noisy_or_late_unless_asked_for(make):
    env = make(Clock())
    rows = play(env)
    assert rows[:, 0].tolist() == list(range(10, 21))
    assert (rows[:, 1:4] == 0).all()
    np.testing.assert_array_equal(env.task.got, np.float32([[k / 10] * 2 for k in range(1, 11)]))


def test_a_late_observation(make):
    env = make(Clock(), late_time={})
    assert env.reset(seed=0)[1] == {"events": {"late_time": {"steps": 2.0}}}
    # The first observation, until the third step sees what was two steps before.
    for _ in range(2):  # and no episode sees one before it
        assert play(env)[:, 0].tolist() == [10, 10, 10, 11, 12, 13, 14, 15, 16, 17, 18]


def test_a_late_observation_in_a_dictionary(make):
    env = make(ByName(), late_time={"steps": 1})
    seen = [float(env.reset(seed=0)[0]["time"][0])]
    seen += [float(env.step(np.zeros(2))[0]["time"][0]) for _ in range(3)]
    assert seen == [10, 10, 11, 12]


def test_a_delay_of_all_observations(make):
    class Both(Clock):
        events = {"late": Event("observation", events.delay, steps=3)}

        def observe(self):
            return {"time": self.seen, "angle": self.seen * 2}

    rows = play(make(Both(), randomize=True))
    assert rows[:, 0].tolist() == [10, 10, 10, 10, 11, 12, 13, 14, 15, 16, 17]
    assert rows[:, 1].tolist() == [20, 20, 20, 20, 22, 24, 26, 28, 30, 32, 34]


def test_a_late_action(make):
    env = make(Clock(), late_action={"steps": 2})
    for _ in range(2):
        play(env)
        # Two steps of 0, then the actions from the first on; the reward judges what the policy did.
        np.testing.assert_allclose(env.task.got, [[k / 10] * 2 for k in [0, 0, 1, 2, 3, 4, 5, 6, 7, 8]])
        env.reset()
        assert env.step(np.array([0.75, 0.0]))[1] == 0.75
        assert env.task.got[0].tolist() == [0.0, 0.0]


def test_before_the_first_action_motors_get_what_is_nearest_to_nothing(make):
    class Pump(Clock):
        action_space = Box(np.float32([0.5, -1.0]), np.float32([1.0, -0.25]))

    env = make(Pump(), late_action={"steps": 1})
    env.reset(seed=0)
    env.step(np.array([1.0, -1.0]))
    assert env.task.got[0].tolist() == [0.5, -0.25]


def test_whole_steps_are_drawn_with_both_ends(make):
    env = make(Clock(), late_action={})
    drawn = [env.reset(seed=seed)[1]["events"]["late_action"]["steps"] for seed in range(100)]
    assert set(drawn) == {1, 2, 3}


def test_a_delay_widens_in_whole_steps(make):
    env = make(Clock(), late_action={"steps": {"from": 0, "to": [0, 4]}})
    for level, expected in [(0.0, {0}), (0.5, {0, 1, 2}), (1.0, {0, 1, 2, 3, 4})]:
        env.set_level(level)
        drawn = {env.reset(seed=seed)[1]["events"]["late_action"]["steps"] for seed in range(100)}
        assert drawn == expected


@pytest.mark.slow
def test_noise_is_as_large_as_was_drawn(make):
    env = make(Clock(), noisy_angle={})
    for seed in range(3):
        drawn = env.reset(seed=seed)[1]["events"]["noisy_angle"]["std"]
        assert 0.1 <= drawn <= 0.2
    env.worlds.shorten(np.zeros(1, np.int64), np.array([3000]))
    rows = play(env, steps=3000)
    drawn = env.reset(seed=0)[1]["events"]["noisy_angle"]["std"]
    angles = rows[:, 1:4]
    # 9003 draws: the deviation is known to 1 / sqrt(2 * 9003) = 0.75 %, the mean to 1 / sqrt(9003) = 1 % of it
    assert angles.std() == pytest.approx(drawn, rel=0.03)
    assert abs(angles.mean()) < 0.04 * drawn
    assert len(np.unique(angles)) > 8900  # a draw of its own for every element and step
    assert (rows[:, 0] == np.arange(10, 3011)).all()  # only what it is of
    assert np.unique(rows[:, 4]).size == 1


def test_noise_on_actions_stays_inside_their_space(make):
    env = make(Clock(), noisy_action={"std": 0.5})
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.array([1.0, 0.0]))
    got = np.array(env.task.got)
    assert got.dtype == np.float32
    assert (np.abs(got) <= 1.0).all()
    assert len(np.unique(got[:, 1])) == 10
    assert (got[:, 0] == 1.0).any()  # noise upwards is lost at the bound


def test_noise_stays_inside_the_bounds_of_its_observation(make):
    class Bounded(Clock):
        observation_bounds = {"angle": (0.0, 0.05)}

    angles = play(make(Bounded(), noisy_angle={}))[:, 1:4]
    assert angles.min() == 0.0
    assert angles.max() == np.float32(0.05)


def test_noise_on_pictures_ends_at_black_and_white(make):
    class Camera(ByName):
        observation_units = {}
        events = {"noisy": Event("observation", events.noise, of="picture", std=50.0)}

        def observe(self):
            return {"picture": np.full((1, 1000), 0 if self.got else 255, np.uint8)}

    env = make(Camera(), noisy={})
    white, _ = env.reset(seed=0)
    black = env.step(np.zeros(2))[0]
    assert white["picture"].min() > 50
    assert (white["picture"] == 255).mean() == pytest.approx(0.5, abs=0.1)
    assert black["picture"].max() < 205
    assert (black["picture"] == 0).mean() == pytest.approx(0.5, abs=0.1)


def test_signals_act_in_the_order_of_the_task(make):
    class Chain(Clock):
        events = {
            "noise": Event("observation", events.noise, of="time", std=1.0),
            "delay": Event("observation", events.delay, of="time", steps=1),
        }

    times = play(make(Chain(), randomize=True))[:, 0]
    # Noise first: the late value is the noisy one as it was, the first two are the same number.
    assert times[0] == times[1] != times[2]


def test_everything_comes_from_the_seed(make):
    env, other = make(Clock(), randomize=True), make(Clock(), randomize=True)

    def episode(env, seed):
        rows = play(env, seed)
        return rows, np.array(env.task.got)

    first = episode(env, 3)
    episode(env, 4)
    np.random.seed(0)  # noqa: NPY002
    for again in (episode(env, 3), episode(other, 3)):
        for known, now in zip(first, again, strict=True):
            np.testing.assert_array_equal(now, known)
    assert not np.array_equal(first[0], episode(env, 5)[0])
    # Noise and delay draw after the task's reset: its episodes start the same with and without them.
    assert make(Clock()).reset(seed=3)[0][4] == first[0][0, 4]


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        (
            Clock,
            {"noisy_angle": {"of": "angel"}},
            "events.noisy_angle: no observation 'angel'. Did you mean 'angle'? There is: time, angle, start.",
        ),
        (Clock, {"noisy_angle": {"std": -0.1}}, "events.noisy_angle.std: -0.1 is not at least 0."),
        (Clock, {"late_action": {"steps": 1.5}}, "events.late_action.steps: 1.5 is not a whole number."),
        (Clock, {"late_action": {"of": "time"}}, "events.late_action: no parameter 'of'. It has: steps."),
        (Clock, {"late_time": {"of": 3}}, "events.late_time.of: expected text or a list, each element text, got 3"),
    ],
)
def test_what_a_recipe_gets_wrong(task, changes, message):
    with pytest.raises(RecipeError) as caught:
        TaskEnv(task(), events=EventSettings(changes=changes))
    assert str(caught.value) == message


def test_only_actions_in_a_box_can_be_noisy():
    class Noisy(Buttons):
        events = {"late": Event("action", events.delay, steps=1)}

    TaskEnv(Noisy()).close()
    with pytest.raises(TaskError) as caught:
        TaskEnv(Noisy(), events=EventSettings(randomize=True))
    assert str(caught.value) == "events.late: only actions in a Box can have noise or delay, not Discrete(2)."


def test_a_signal_of_the_authors_own(make):
    @events.acts_at("observation")
    def stuck(rng, first, *, chance: events.Fraction):
        drawn = float(rng.uniform(*chance))
        last = dict(first)

        def hold(parts):
            if rng.random() >= drawn:
                last.update({name: value.copy() for name, value in parts.items()})
            return last

        return {"chance": drawn}, hold

    class Stuck(Slider):
        events = {"stuck": Event("observation", stuck, of="place", chance=1.0)}

    env = make(Stuck(start=0.5), stuck={})
    assert play(env, steps=3)[:, 0].tolist() == [0.5] * 4


def test_a_signal_function_that_gives_none():
    class Broken(Slider):
        events = {"broken": Event("observation", lambda rng, first: {"std": 1.0}, enabled=True)}

    with pytest.raises(
        TaskError, match=r"^events\.broken: its function must return the drawn values and a signal, not "
    ):
        TaskEnv(Broken())
