"""Tasks in batches: an episode has the same bits alone and in any world, whatever the other worlds do."""

import contextlib
import sys
from contextlib import closing
from importlib import metadata

import numpy as np
import pytest

from rlctl.engine import MUJOCO, PYBULLET
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ShapeError, TaskError, UsageError, WorldFailed
from rlctl.task import BatchTask
from rlctl.task.batch import WorldRngs
from rlctl.task.env import TaskEnv
from rlctl.task.mujoco.world import MujocoWorld
from rlctl.task.worlds import TaskWorlds
from tests.task.batches import Stool

pytest.importorskip("mujoco")

STOOL = "tests.task.batches:Stool"
SEEDS = range(12)
EVENTS = {
    "none": {},
    "reset": {"events": {name: {} for name in ("mass", "friction", "strength", "gravity", "damping")}},
    "start": {"events": {"offset": {}}},
    "interval": {"events": {"kick": {}, "push": {}}},
    "observation": {"events": {name: {} for name in ("noise", "late", "late_noise", "quiver")}},
    "action": {"events": {"action_noise": {}, "late_action": {}}},
    "all": {"randomize": True},
    "all, at a level": {"randomize": True, "level": 0.5, "events": {"late": {"steps": {"from": [0, 0], "to": [2, 6]}}}},
}


def actions_of(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (30, 2)).astype(np.float32)


def play_alone(env: TaskEnv, seed: int) -> list[np.ndarray]:
    """Return a row per step: observation, reward, terms, flags and success."""
    rows = [env.reset(seed=seed)[0]]
    for action in actions_of(seed):
        observation, reward, terminated, truncated, info = env.step(action)
        numbers = [reward, *info["metrics"].values(), terminated, truncated, info["is_success"]]
        rows.append(np.concatenate([observation, numbers]))
        if terminated or truncated:
            break
    return rows


def play_together(batch, choose) -> dict[int, list[np.ndarray]]:
    """Play all episodes; `choose(step, worlds)` returns the worlds to step, of those that play."""
    waiting, playing, episodes = list(SEEDS), {}, {}

    def begin(worlds):
        seeds = [waiting.pop(0) for _ in worlds]
        for world, seed, first in zip(worlds, seeds, batch.reset(np.array(worlds), seeds), strict=True):
            playing[world], episodes[seed] = seed, [first]

    begin(list(range(batch.count)))
    step = 0
    while playing:
        worlds, step = np.array(choose(step, sorted(playing))), step + 1
        seeds = [playing[world] for world in worlds.tolist()]
        actions = np.stack([actions_of(seed)[len(episodes[seed]) - 1] for seed in seeds])
        result = batch.step(actions, None if np.array_equal(worlds, np.arange(batch.count)) else worlds)
        ended = result.terminated | result.truncated
        for k, seed in enumerate(seeds):
            numbers = [result.reward[k], *result.terms[k], result.terminated[k], result.truncated[k], result.success[k]]
            episodes[seed].append(np.concatenate([result.observation[k], numbers]))
        for world in worlds[ended].tolist():
            del playing[world]
        if count := min(len(waiting), int(ended.sum())):
            begin(worlds[ended].tolist()[:count])
    return episodes


@pytest.fixture
def make_both():
    """Return the environment of one world and that of several."""
    made = []

    def make(worlds: int, **settings):
        env = EnvSpec(STOOL, **settings).make()
        made.append(env)
        made.append(EnvSpec(STOOL, **settings).make_worlds(worlds))
        return made[-2:]

    yield make
    for env in made:
        env.close()


@pytest.mark.slow_except("all, at a level")
@pytest.mark.parametrize("case", EVENTS)
def test_an_episode_has_the_same_bits_alone_and_among_others(make_both, case):
    env, batch = make_both(5, **EVENTS[case])
    rng = np.random.default_rng(0)
    some = play_together(batch, lambda _, worlds: rng.permutation(worlds)[: rng.integers(1, 6)])
    every = play_together(batch, lambda _, worlds: worlds)
    lengths = set()
    for seed in SEEDS:
        alone = play_alone(env, seed)
        lengths.add(len(alone))
        for rows in (some[seed], every[seed]):
            assert len(rows) == len(alone)
            for one, other in zip(alone, rows, strict=True):
                np.testing.assert_array_equal(one, other)
    assert len(lengths) > 2  # so worlds began episodes at different times


@pytest.mark.slow
def test_a_batch_of_one_world(make_both):
    env, batch = make_both(1, randomize=True)
    episodes = play_together(batch, lambda _, worlds: worlds)
    for seed in SEEDS:
        np.testing.assert_array_equal(np.array(play_alone(env, seed)[1:]), np.array(episodes[seed][1:]))


def test_gymnasium_makes_one_world():
    import gymnasium

    import rlctl.gym  # noqa: F401

    with closing(gymnasium.make("rlctl/walk-v0", disable_env_checker=True)) as env:
        observation, _ = env.reset(seed=1)
        assert observation.shape == (45,)
        assert env.spec.max_episode_steps == 500


def state_of(batch, worlds):
    kept = [getattr(batch.task, name)[worlds].copy() for name in batch.task.per_world]
    return [batch.sim.world.batch.state[worlds].copy(), *kept]


def test_a_step_or_a_reset_of_some_worlds_leaves_the_others_alone(make_both):
    _, batch = make_both(5, randomize=True)
    batch.reset(np.arange(5), range(5))
    for _ in range(4):
        batch.step(np.full((5, 2), 0.4, np.float32))
    others = np.array([0, 2, 3])
    before = state_of(batch, others)
    batch.step(np.full((2, 2), -0.8, np.float32), np.array([1, 4]))
    batch.reset(np.array([4]), [77])
    for one, other in zip(before, state_of(batch, others), strict=True):
        np.testing.assert_array_equal(one, other)
    assert batch.step_of.tolist() == [4, 5, 4, 4, 0]


class Meddler(Stool):
    """In each step it changes the model of all worlds, and fails if it is told to."""

    fails = False

    def act(self, action):
        super().act(action)
        self.body.set_friction(0.1 + 0.01 * self.steps.max())
        self.body.set_joint_damping(2.0 + self.steps.max())
        self.body.set_base(np.tile([0.0, 0.0, 0.3 + 0.1 * self.steps.max()], (len(action), 1)))
        if self.fails:
            raise RuntimeError("on purpose")


@pytest.mark.parametrize("fails", [False, True])
def test_others_keep_their_model_and_a_failed_step_leaves_them_alone_too(fails):
    with closing(TaskWorlds(Meddler(), 4, sim=MUJOCO)) as batch:
        batch.reset(np.arange(4), range(4))
        batch.step(np.full((4, 2), 0.4, np.float32))
        others = np.array([0, 2])
        world = batch.sim.world
        height = batch.task.body.base_position[others, 2]
        names = ["pair_friction", "dof_damping", "friction", "actuator_biasprm"]
        before = [*state_of(batch, others), *(world.model(name)[others].copy() for name in names)]
        batch.task.fails = fails
        with contextlib.suppress(RuntimeError):
            batch.step(np.full((2, 2), -0.8, np.float32), np.array([1, 3]))
        after = [*state_of(batch, others), *(world.model(name)[others] for name in names)]
        for one, other in zip(before, after, strict=True):
            np.testing.assert_array_equal(one, other)
        assert (world.model("dof_damping")[1] != world.model("dof_damping")[0]).any()
        # What was computed from the state that was taken back is computed again.
        np.testing.assert_array_equal(batch.task.body.base_position[others, 2], height)


def test_random_numbers_of_worlds_have_a_row_each():
    rngs = WorldRngs([np.random.default_rng(seed) for seed in (1, 2)])
    drawn = rngs.uniform(-1, 1, 3)
    assert drawn.shape == (2, 3)
    np.testing.assert_array_equal(drawn[1], np.random.default_rng(2).uniform(-1, 1, 3))
    assert rngs.integers(5).shape == (2,)
    with pytest.raises(AttributeError, match="Generator has no method 'unifrom'"):
        rngs.unifrom(1)


FAULTS = {
    "observation": "Stool: observation 'hips' is not finite at step 3",
    "reward": "Stool: reward term 'height' is (not finite|nan) at step 3",
    "unstable": "MuJoCo: (positions|velocities) are not finite or too large: the simulation is unstable",
}


def step_on(env, action):
    for _ in range(6):
        env.step(action)


@pytest.mark.parametrize("fault", FAULTS)
def test_the_world_that_fails_is_named(make_both, fault):
    # Goals are drawn between 0.2 and 0.3 m: of these seeds one has a goal above 0.285 m.
    env, batch = make_both(5, parameters={"fault": fault, "faulty_start": 0.285})
    batch.reset(np.arange(5), range(5))
    (bad,) = np.flatnonzero(batch.task.goal > 0.285).tolist()
    assert bad > 0
    with pytest.raises(WorldFailed, match=f"^{FAULTS[fault]}") as caught:
        step_on(batch, np.zeros((5, 2), np.float32))
    assert caught.value.world == bad
    assert batch.step_of[bad] == (4 if fault == "unstable" else 3)  # physics fails in the step after
    env.reset(seed=bad)
    with pytest.raises(TaskError, match=f"^{FAULTS[fault]}"):
        step_on(env, np.zeros(2, np.float32))


class Broken(Stool):
    """What `fault` names is of the wrong shape, from the second world on if it ends with `later`."""

    def changed(self, where, value):
        return value[0] if self.fault == where else value[:1] if self.fault == f"{where} later" else value

    def rewards(self, action):
        terms = super().rewards(action)
        return {**terms, "effort": self.changed("rewards", terms["effort"])}

    def observe(self):
        parts = super().observe()
        if self.fault == "kept":
            self.seen = self.seen.sum(axis=0)
        return {**parts, "speeds": self.changed("observe", parts["speeds"])}

    def is_terminated(self):
        return self.changed("is_terminated", super().is_terminated())

    def is_success(self):
        flags = self.changed("is_success", super().is_success())
        return flags * 1.0 if self.fault == "numbers" else flags


ROW = "expected numbers of shape"
SHAPES = {
    "rewards": f"Broken: rewards()['effort'] is an array of float32 of shape (), {ROW} (1,): a row per world",
    "observe": f"Broken: observe()['speeds'] is an array of float64 of shape (2,), {ROW} (1, size): a row per world",
    "is_terminated": "Broken: is_terminated() is an array of bool of shape (), expected bool of shape (1,): a row per "
    "world",
    "is_success": "Broken: is_success() is an array of bool of shape (), expected bool of shape (1,): a row per world",
    "numbers": "Broken: is_success() is an array of float64 of shape (1,), expected bool of shape (1,): a row per "
    "world",
    "rewards later": f"Broken: rewards()['effort'] is an array of float32 of shape (1,), {ROW} (3,): a row per world",
    "observe later": f"Broken: observe()['speeds'] is an array of float64 of shape (1, 2), {ROW} (3, size): a row per "
    "world",
    "is_terminated later": "Broken: is_terminated() is an array of bool of shape (1,), expected bool of shape (3,): a "
    "row per world",
    "kept": "Broken: after reset self.seen has shape (2,); per_world declares (1, 2)",
}


@pytest.mark.parametrize("fault", SHAPES)
def test_an_array_of_the_wrong_shape(fault):
    spec = EnvSpec(f"{__name__}:Broken", {"fault": fault})

    def play():
        with closing(spec.make()) as env:
            if fault.endswith("later") or fault == "kept":
                with closing(spec.make_worlds(3)) as batch:
                    batch.reset(np.arange(3), range(3))
                    batch.step(np.zeros((3, 2), np.float32))
            env.reset(seed=0)
            env.step(np.zeros(2, np.float32))

    with pytest.raises(TaskError if fault == "kept" else ShapeError) as caught:
        play()
    assert str(caught.value) == SHAPES[fault]


class WithoutAct(BatchTask):
    action_space = Stool.action_space

    def build(self, sim): ...
    def observe(self): ...
    def rewards(self, action): ...


def test_a_missing_method():
    with pytest.raises(TaskError) as caught:
        TaskEnv(WithoutAct(), sim=MUJOCO)
    assert str(caught.value) == "WithoutAct does not define act(); a task needs build, act, observe, rewards"


def test_a_mujoco_without_batches_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.batch", None)  # as before version 4
    version = metadata.version("mujoco")
    with pytest.raises(
        UsageError, match=rf"^a batch of worlds needs MuJoCo 4 or later, and {version} is installed: pip"
    ):
        MujocoWorld(substeps=1, count=2)
    MujocoWorld(substeps=1, count=1)


def test_batches_need_mujoco_and_no_wrappers():
    with pytest.raises(UsageError, match="simulates its worlds in MuJoCo"):
        EnvSpec(STOOL, sim=PYBULLET).make()
    spec = EnvSpec(STOOL, frame_stack=2)
    with closing(spec.make()), pytest.raises(UsageError, match="no frame_stack and no time_feature"):
        spec.make_worlds(2)


def test_an_event_function_that_fails_names_its_world(make_both):
    env, batch = make_both(3, events={"quiver": {}})
    batch.reset(np.arange(3), range(3))
    batch._signals.on_observation[0]._own[1] = lambda parts: {"hight": parts["height"]}
    with pytest.raises(KeyError) as caught:
        batch.step(np.zeros((3, 2), np.float32))
    assert caught.value.world == 1
    assert env.observation_sizes["height"] == 1


class Ending(Stool):
    """Its episodes end in the fourth step where the goal is high, and as failures choose the level of the next."""

    def is_truncated(self):
        return (self.steps == 4) & (self.goal > 0.25)

    def next_levels(self):
        return np.where(self.goal > 0.25, 1.5, self.goal)


def test_a_task_truncates_its_episodes_before_the_time_limit():
    worlds = np.arange(len(SEEDS))
    with contextlib.closing(TaskWorlds(Ending(), len(SEEDS))) as batch:
        batch.reset(worlds, list(SEEDS))
        high = batch.task.goal > 0.25
        assert 0 < high.sum() < len(high)
        for step in range(1, 5):
            result = batch.step(np.zeros((len(SEEDS), 2)))
            assert not result.terminated.any()
            assert np.array_equal(result.truncated, high & (step == 4))
        # Levels are within [0, 1].
        levels = [batch.next_level(world) for world in worlds]
        assert levels == [
            1.0 if is_high else round(goal, 9) for is_high, goal in zip(high, batch.task.goal, strict=True)
        ]
        # Some of the worlds alone.
        chosen = worlds[high][:2]
        batch.reset(chosen, [SEEDS[world] for world in chosen])
        truncated = [batch.step(np.zeros((2, 2)), chosen).truncated for _ in range(4)]
        assert np.array_equal(truncated, [[False] * 2] * 3 + [[True] * 2])
    assert Stool().next_levels() is None
