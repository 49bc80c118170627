"""How fast workers play with a policy, against stepping all environments by turns with a batched policy in torch."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rlctl.env_spec import EnvSpec
from rlctl.rollout.collect import play_episodes
from rlctl.rollout.messages import Play
from rlctl.rollout.seeds import Stream, episode_seed
from rlctl.rollout.workers import Workers, available_cores
from rlctl.run.acting import Exploration
from rlctl.run.policy import PolicyInfo
from tests.benchmarks.row import Row, side_by_side
from tests.benchmarks.stepping_workers import SteppingWorkers

MANY = 64
STEPS = 40  # of each environment in a segment
HIDDEN = 64
EPISODES = 100
SAMPLES = Exploration(stochastic=True)


def reach(repeat: int) -> Row:
    """Count environment steps of `reach`, resets included."""
    return _row("reach", 1.6, repeat)


def half_cheetah(repeat: int) -> Row:
    """Count environment steps of `half-cheetah`, resets included."""
    return _row("half-cheetah", 1.5, repeat)


def evaluation(repeat: int) -> Row:
    """Count environment steps of 100 whole episodes of `reach`, as `rlctl eval` plays them."""
    workers = Workers(EnvSpec("reach"), available_cores())
    policy = make_policy(workers)
    workers.set_policy(*policy)
    turns = _Turns("reach", policy)

    def play() -> float:
        began = time.perf_counter()
        steps = sum(episode.result.length for episode in play_episodes(workers, range(EPISODES)))
        return steps / (time.perf_counter() - began)

    pair = side_by_side(play, lambda: turns.play(2), 2 * repeat + 1)
    workers.close()
    turns.workers.close()
    return Row(
        "evaluating reach",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        ">= 2.5x",
        pair.ratio >= 2.5,
        f"{EPISODES} episodes on {available_cores()} cores, each whole inside a worker, against one step of {MANY} "
        "environments at a time and the policy in torch",
    )


def per_step(repeat: int) -> Row:
    """Count what a step costs with 8 and with 256 environments."""
    few, many = (_Player(Workers(EnvSpec("reach"), n_envs)) for n_envs in (8, 256))
    pair = side_by_side(lambda: few.play(8), lambda: many.play(1), 2 * repeat + 1)
    few.workers.close()
    many.workers.close()
    return Row(
        "256 against 8 environments",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ours:,.0f} steps/s",
        f"{1 / pair.ratio:.2f}x",
        ">= 0.9x",
        1 / pair.ratio >= 0.9,
        f"environment steps of reach with a policy on {available_cores()} cores: 256 environments against 8",
    )


def _row(task: str, target: float, repeat: int) -> Row:
    workers = Workers(EnvSpec(task), MANY)
    player = _Player(workers)
    turns = _Turns(task, make_policy(workers))
    pair = side_by_side(lambda: player.play(2), lambda: turns.play(2), 2 * repeat + 1)
    workers.close()
    turns.workers.close()
    return Row(
        f"playing {task}",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        f">= {target}x",
        pair.ratio >= target,
        f"{MANY} environments on {available_cores()} cores with a {HIDDEN}-{HIDDEN} policy: segments of {STEPS} steps "
        "inside the workers, against one step of all environments at a time and the policy in torch",
    )


class _Player:
    """Segments, as on-policy training plays them."""

    def __init__(self, workers: Workers) -> None:
        self.workers = workers
        self._policy = make_policy(workers)
        self._started = [0] * workers.n_envs
        self._begin()

    def _begin(self) -> None:
        seeds = {env: episode_seed(0, Stream.TRAIN, env, 0) for env in range(self.workers.n_envs)}
        self._play(seeds)

    def _play(self, begin: dict[int, int]) -> None:
        self.workers.set_policy(*self._policy)
        self.workers.start_playing(Play(STEPS, begin, dict(enumerate(self._started)), exploration=SAMPLES))
        for result in self.workers.finish_playing():
            self._started[result.env] += 1

    def play(self, segments: int) -> float:
        """Return steps per second."""
        began = time.perf_counter()
        for _ in range(segments):
            self._play(dict.fromkeys(range(self.workers.n_envs), -1))
        return segments * STEPS * self.workers.n_envs / (time.perf_counter() - began)


class _Turns:
    """All environments step by step with a batched policy in torch, as before workers acted."""

    def __init__(self, task: str, policy: tuple[PolicyInfo, dict[str, NDArray[Any]]]) -> None:
        self.workers = SteppingWorkers(task, MANY, available_cores())
        info, tensors = policy
        self._weights = [torch.from_numpy(tensors[f"policy/{name}.weight"]) for name in _LAYERS]
        self._low, self._high = info.env.spaces()[1].low, info.env.spaces()[1].high  # type: ignore[attr-defined]
        self._mean, self._scale = tensors["normalize//mean"], np.sqrt(tensors["normalize//var"] + 1e-8)
        torch.set_num_threads(1)

    def _act(self, observations: NDArray[Any]) -> NDArray[Any]:
        normalized = np.clip((observations - self._mean) / self._scale, -10, 10).astype(np.float32)
        with torch.no_grad():
            value = torch.from_numpy(normalized)
            for weight in self._weights[:-1]:
                value = torch.tanh(value @ weight.T)
            mean = value @ self._weights[-1].T
            sampled: NDArray[Any] = torch.normal(mean, 0.5).numpy()
        return np.clip(sampled, self._low, self._high)

    def play(self, segments: int) -> float:
        """Return steps per second."""
        workers = self.workers
        began = time.perf_counter()
        for _ in range(segments * STEPS):
            workers.action[:] = self._act(workers.observation.copy())
            workers.step()
        return segments * STEPS * MANY / (time.perf_counter() - began)


_LAYERS = ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net")


def make_policy(workers: Workers) -> tuple[PolicyInfo, dict[str, NDArray[Any]]]:
    """Return a policy of random numbers."""
    rng = np.random.default_rng(0)
    observations, actions = (int(np.prod(space.shape or ())) for space in workers.info.spaces())
    sizes = [observations, HIDDEN, HIDDEN, actions]
    tensors: dict[str, NDArray[Any]] = {"policy/log_std": np.full(actions, np.log(0.5), np.float32)}
    for name, before, after in zip(_LAYERS, sizes[:-1], sizes[1:], strict=True):
        tensors[f"policy/{name}.weight"] = (0.1 * rng.standard_normal((after, before))).astype(np.float32)
        tensors[f"policy/{name}.bias"] = np.zeros(after, np.float32)
    tensors |= {"normalize//mean": np.zeros(observations), "normalize//var": np.ones(observations)}
    info = PolicyInfo(
        algo="ppo",
        policy="MlpPolicy",
        env=workers.info,
        spec=workers.spec,
        normalized_keys=[""],
        clip_observation=10.0,
    )
    return info, tensors
