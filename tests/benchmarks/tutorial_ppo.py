"""Trains the tutorial environment as tutorials do, and prints the result as JSON.

SB3's PPO on `SubprocVecEnv` x 8, rollouts of 2,048 steps, batches of 256, 10 epochs, everything else at its default.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from tests.benchmarks.tutorial_env import TutorialReach

EVAL_EVERY = 3  # rollouts: about as many steps as in our recipe
EPISODES = 100


class UntilGood(BaseCallback):
    """Evaluates between updates; ends the training when it is good enough, or out of time."""

    def __init__(self, eval_env: VecEnv, good: float, deadline: float) -> None:
        super().__init__()
        self.eval_env = eval_env
        self.good = good
        self.deadline = deadline
        self.success = 0.0
        self._rollouts = 0

    @property
    def solved(self) -> bool:
        return self.success >= self.good

    def _on_rollout_start(self) -> None:
        if self._rollouts and self._rollouts % EVAL_EVERY == 0:
            self.success = self._evaluated()
        self._rollouts += 1

    def _on_step(self) -> bool:
        return not self.solved and time.time() < self.deadline

    def _evaluated(self) -> float:
        successes: list[bool] = []

        def keep(frame: dict[str, Any], _: Any) -> None:
            if frame["done"]:
                successes.append(frame["info"]["is_success"])

        evaluate_policy(self.model, self.eval_env, EPISODES, callback=keep)
        return sum(successes) / len(successes)


def make_envs() -> VecEnv:
    return make_vec_env(TutorialReach, n_envs=8, vec_env_cls=SubprocVecEnv)


def measure_speed(model: PPO, steps: int) -> dict[str, float]:
    """Train for so many steps; return the steps per second, without imports and building."""
    began = time.perf_counter()
    model.learn(steps)
    return {"steps_per_second": model.num_timesteps / (time.perf_counter() - began)}


def learn_until(model: PPO, good: float, started: float, limit: float) -> dict[str, float]:
    """Train until an evaluation is good enough; return the seconds since `started` (of `time.time`) and the steps."""
    eval_env = make_envs()
    callback = UntilGood(eval_env, good, started + limit)
    model.learn(10**9, callback)
    seconds = time.time() - started
    eval_env.close()
    return {
        "seconds": seconds,
        "solved": callback.solved,
        "success": callback.success,
        "steps": model.num_timesteps,
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int)
    parser.add_argument("--until", type=float)
    parser.add_argument("--started", type=float, default=time.time())
    parser.add_argument("--limit", type=float, default=600.0)
    options = parser.parse_args()
    envs = make_envs()
    model = PPO("MlpPolicy", envs, n_steps=2048, batch_size=256, n_epochs=10, device="cpu", seed=0)
    if options.steps:
        result = measure_speed(model, options.steps)
    else:
        result = learn_until(model, options.until, options.started, options.limit)
    envs.close()
    print(json.dumps(result))


if __name__ == "__main__":
    main()
