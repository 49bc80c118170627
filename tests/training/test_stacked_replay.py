"""Replay buffers that store each value of a history once have the same minibatches, bit for bit, as whole copies."""

from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from safetensors.numpy import load_file
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

from rlctl.recipe.recipe import merge
from rlctl.task.history import TermHistory
from rlctl.task.layout import Layout
from rlctl.training import algorithms
from rlctl.training.checkpoint_file import ReplayParts
from rlctl.training.stacked_replay import StackedRows, Stacking, store_once
from tests.training.envs import Image, Line

__all__ = ("Line",)  # loaded by path


class DiscreteImage(Image):
    """A small camera, and two actions."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(2)

    def step(self, action):
        return super().step([2.0 * action - 1.0])


SIZES, FRAMES = {"q": 2, "goal": 1, "v": 1}, {"q": 3, "v": 2}
WIDTH, ENVS, ROWS = 9, 3, 20
# q (oldest first), goal, v: which of the newest values (q, q, goal, v), and how many steps ago.
SOURCE = np.array([0, 1, 0, 1, 0, 1, 2, 3, 3])
BACK = np.array([2, 2, 1, 1, 0, 0, 0, 1, 0])


def make_buffer(kind, *, once, start="first"):
    space = spaces.Box(-np.inf, np.inf, (WIDTH,), np.float32)
    options = {"n_steps": 3} if kind is NStepReplayBuffer else {}
    buffer = kind(ROWS * ENVS, space, spaces.Box(-1, 1, (1,), np.float32), "cpu", n_envs=ENVS, **options)
    store_once(buffer, Stacking(SOURCE, BACK) if once else None, start)
    return buffer


def list_steps(count, start="first"):
    """Return steps of all environments: episodes end after random times, some at a time limit or cut short."""
    rng = np.random.default_rng(0)
    history, everyone = TermHistory(ENVS, FRAMES, start), np.arange(ENVS)

    def stack(rows, envs):
        parts = history.add(Layout(SIZES).split(rows), envs)
        return np.concatenate([*parts.values()], axis=1)

    now = stack(rng.normal(size=(ENVS, 4)), everyone).astype(np.float32)
    steps = []
    for number in range(count):
        after = stack(rng.normal(size=(ENVS, 4)), everyone).astype(np.float32)
        done, limit, cut = rng.random(ENVS) < 0.2, rng.random(ENVS) < 0.5, number % 13 == 7
        infos = [{"TimeLimit.truncated": bool(flag)} for flag in done & limit]
        steps.append((cut, now, after, rng.normal(size=(ENVS, 1)), rng.normal(size=ENVS), done, infos))
        begins = np.flatnonzero(done | cut)
        history.begin(begins)
        now = after.copy()
        now[begins] = stack(rng.normal(size=(len(begins), 4)), begins)
    return steps


def play(buffers, steps):
    for cut, *step in steps:
        for buffer in buffers:
            buffer.add(*step)
            if cut:  # as at the start of a stage
                buffer.timeouts[buffer.pos - 1, buffer.dones[buffer.pos - 1] == 0.0] = 1.0


def assert_same_samples(ours, theirs):
    stored = ours.buffer_size if ours.full else ours.pos
    for name in ("observations", "next_observations"):
        np.testing.assert_array_equal(getattr(ours, name)[:stored], getattr(theirs, name)[:stored])
    samples = []
    for buffer in (ours, theirs):
        np.random.seed(0)  # noqa: NPY002 (the buffers draw there)
        samples.append(buffer.sample(64))
    for one, other in zip(*samples, strict=True):
        assert one is other or (one == other).all()


@pytest.mark.parametrize("kind", [ReplayBuffer, NStepReplayBuffer])
@pytest.mark.parametrize("steps", [5, 20, 21, 73])  # before the ring is full, just full, and later
@pytest.mark.parametrize("start", ["first", "zeros"])
def test_the_same_minibatches(kind, steps, start):
    ours, theirs = (make_buffer(kind, once=once, start=start) for once in (True, False))
    play([ours, theirs], list_steps(steps, start))
    assert_same_samples(ours, theirs)


@pytest.mark.parametrize("steps", [5, 21, 73])
@pytest.mark.parametrize("start", ["first", "zeros"])
def test_saved_and_loaded(tmp_path, steps, start):
    ours, theirs = (make_buffer(ReplayBuffer, once=once, start=start) for once in (True, False))
    played = list_steps(steps + 30, start)
    play([ours, theirs], played[:steps])
    parts = ReplayParts(tmp_path, ours).save(steps)
    restored = make_buffer(ReplayBuffer, once=True, start=start)
    ReplayParts(tmp_path, restored).load(parts, steps)
    assert_same_samples(restored, theirs)
    for first in (steps, steps + 1, steps + 15):  # the oldest transitions are replaced one after the other
        play([restored, theirs], played[first : first + (1 if first == steps else 14)])
        assert_same_samples(restored, theirs)


CASES = {
    "frames": ("Line", {"algo": "sac", "frame_stack": 3}),
    "pictures": ("DiscreteImage", {"algo": "dqn", "frame_stack": 2}),
    "histories": (
        "tests.task.batches:Stool",
        {"algo": "tqc", "observe": ["speeds", "hips", "goal"], "observation_history": {"hips": 3}, "privileged": {}},
    ),
    "SB3's own update": ("Line", {"algo": "td3", "frame_stack": 3, "policy_kwargs": {"activation_fn": "elu"}}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_same_training(train, monkeypatch, case):
    env, settings = CASES[case]
    off_policy = {"learning_starts": 24, "batch_size": 16, "buffer_size": 60, "train_freq": 4, "gradient_steps": 2}
    settings = merge({"n_envs": 2, "total_timesteps": 96, "eval": {"episodes": 1}, "algo_kwargs": off_policy}, settings)
    ours = load_file(train(env, settings, envs=Path(__file__)).run.last_policy)
    monkeypatch.setattr(algorithms, "store_once", lambda *_: None)
    theirs = load_file(train(env, settings, envs=Path(__file__)).run.last_policy)
    assert ours.keys() == theirs.keys()
    for name, values in ours.items():
        np.testing.assert_array_equal(values, theirs[name], err_msg=name)


def test_memory_by_hand():
    buffer = make_buffer(ReplayBuffer, once=True)
    assert isinstance(buffer.observations, StackedRows)
    # Newest values before 20 + 2 steps and after 20, four of 4 bytes each, and ages of 2 bytes; 3 environments.
    assert buffer.observations.stacks.nbytes == 3 * ((22 + 20) * 4 * 4 + 22 * 2)
    whole = make_buffer(ReplayBuffer, once=False)
    assert whole.observations.nbytes + whole.next_observations.nbytes == 3 * 2 * 20 * 9 * 4
