"""The updates alone, on made-up rollouts and replay buffers: time per sample, and how much of it uses all cores."""

from __future__ import annotations

import contextlib
import os
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from rlctl.play.workers import available_cores
from rlctl.policy.torch_policy import pin_threads
from rlctl.training.updates.blocks import MAX_BLOCKS, OFF_POLICY_BLOCKS
from rlctl.training.updates.choice import choose_update
from tests.benchmarks.row import Row, side_by_side

N_ENVS, STEPS, UPDATES = 256, 24, 64


def ppo(repeat: int) -> Row:
    """Count microseconds per sample of PPO's whole update, all epochs."""
    samples = N_ENVS * STEPS
    network = {"net_arch": [128, 128]}

    def make() -> Any:
        settings: dict[str, Any] = {"n_steps": STEPS, "batch_size": samples // 4, "n_epochs": 5, "seed": 0}
        model = PPO("MlpPolicy", _make_env(45, 12, N_ENVS), policy_kwargs=network, device="cpu", **settings)
        _fill(model.rollout_buffer, "observations", "actions", "advantages", "returns", "values")
        model.rollout_buffer.log_probs[...] = -17  # of 12 standard normal numbers
        return model

    def train(learner: Any, model: Any) -> None:
        model.rollout_buffer.full = True
        learner.train()

    what = f"PPO's update of {samples:,} samples"
    return _compare(what, make, train, samples, "us/sample", 25.0, 2 * MAX_BLOCKS, repeat)


def tqc(repeat: int) -> Row:
    """Count microseconds per update of TQC with half-cheetah's sizes."""
    network = {"net_arch": [128, 128]}

    def make() -> Any:
        settings: dict[str, Any] = {"batch_size": 128, "buffer_size": 10_000, "use_sde": True, "seed": 0}
        model = TQC("MlpPolicy", _make_env(26, 6, 1), policy_kwargs=network, device="cpu", **settings)
        _fill(model.replay_buffer, "observations", "next_observations", "actions", "rewards")
        model.replay_buffer.full = True
        return model

    def train(learner: Any, model: Any) -> None:
        learner.train(gradient_steps=UPDATES, batch_size=128)

    # half-cheetah has an update for every four steps: 2,500 us are 1,600 steps/s.
    what = "TQC's update of 128 transitions"
    return _compare(what, make, train, UPDATES, "us/update", 2500.0, OFF_POLICY_BLOCKS, repeat)


def _compare(
    what: str,
    make: Callable[[], Any],
    train: Callable[[Any, Any], None],
    count: int,
    unit: str,
    target: float,
    most: int,
    repeat: int,
) -> Row:
    """Compare the time on all cores with that on one; estimate it for `most` cores, which are used at most."""
    pin_threads()
    pairs = []
    for cores in (available_cores(), 1):
        model = make()
        model.set_logger(Logger(None, []))
        with _limit_cores(cores):
            pairs.append((choose_update(model), model))
    shared = _measure_blocks(pairs[1][0])

    def measure(learner: Any, model: Any) -> float:
        began = time.perf_counter()
        train(learner, model)
        return (time.perf_counter() - began) / count * 1e6

    parts: list[float] = []

    def measure_on_one() -> float:
        shared.clear()
        total = measure(*pairs[1])
        parts.append(sum(shared) / count * 1e6 / total)
        return total

    for pair in pairs:
        measure(*pair)  # the processes start
    pair = side_by_side(lambda: measure(*pairs[0]), measure_on_one, 3 * repeat)
    for learner, _ in pairs:
        learner.close()
    part = statistics.median(parts)
    many = pair.theirs * (1 - part + part / most)
    return Row(
        what,
        f"{pair.ours:.1f} {unit}",
        f"{pair.theirs:.1f} {unit}",
        f"{1 / pair.ratio:.2f}x",
        f"<= {target:g} {unit}",
        pair.ours <= target,
        f"on {available_cores()} cores against one; all cores share {part:.1%} of the time on one core, by Amdahl "
        f"{many:.1f} {unit} on {most} cores ({pair.theirs / many:.1f}x; an estimate, without waking processes)",
    )


def _measure_blocks(learner: Any) -> list[float]:
    """Return a list to which the learner adds the seconds that it computes blocks."""
    blocks = getattr(learner, "_blocks")  # noqa: B009 (a private attribute)
    seconds: list[float] = []
    run = blocks.run

    def timed(phase: int, tasks: int) -> None:
        began = time.perf_counter()
        run(phase, tasks)
        if tasks > 1:
            seconds.append(time.perf_counter() - began)

    blocks.run = timed
    return seconds


@contextlib.contextmanager
def _limit_cores(count: int) -> Iterator[None]:
    before = os.environ.get("RLCTL_CORES")
    os.environ["RLCTL_CORES"] = str(count)
    try:
        yield
    finally:
        os.environ.pop("RLCTL_CORES")
        if before is not None:
            os.environ["RLCTL_CORES"] = before


class _Still(gym.Env):  # type: ignore[type-arg]
    """Spaces; it is never stepped."""

    def __init__(self, observations: int, actions: int) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (observations,), np.float32)
        self.action_space = spaces.Box(-1, 1, (actions,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros(self.observation_space.shape, np.float32), {}


def _make_env(observations: int, actions: int, count: int) -> DummyVecEnv:
    return DummyVecEnv([lambda: _Still(observations, actions)] * count)


def _fill(buffer: Any, *names: str) -> None:
    rng = np.random.default_rng(0)
    for name in names:
        rows = getattr(buffer, name)
        rows[...] = rng.standard_normal(rows.shape)
