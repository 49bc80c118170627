"""Real trainings made sick on purpose: the diagnosis finds why."""

import pytest

from rlctl.environments.spec import merge
from rlctl.runs.diagnosis.findings import Grade, diagnose

SHORT = {"total_timesteps": 60_000, "eval": {"every_steps": 12_000, "episodes": 10}}
# The end comes from a clock that is not observed, and is said to be a termination.
CLOCK = """
import gymnasium
import numpy as np


class Clock(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._observe(), {}

    def _observe(self):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def step(self, action):
        self.steps += 1
        return self._observe(), -1.0, self.steps == 50, False, {}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("id", "settings"),
    [
        ("Q2", {"reward_weights": {"distance": 1.0, "reached": -1.0}}),
        ("Q3", {"algo_kwargs": {"learning_rate": 0.036}}),  # 30 times the recipe's
        ("Q12", {"policy_kwargs": {"log_std_init": -9}}),  # no exploration
        # All actions at their limits; with as many updates as reach's recipe makes, the mean still learns a little.
        ("Q12", {"policy_kwargs": {"log_std_init": 3}, "n_envs": 64, "algo_kwargs": {"batch_size": 640}}),
    ],
)
def test_reach_made_sick(train, id, settings):
    result = train("reach", merge(SHORT, settings), check=False)
    assert id in [each.id for each in diagnose(result.run) if each.grade == Grade.WARNING]


@pytest.mark.slow
def test_time_limit_as_termination(train, write_module):
    settings = {
        "n_envs": 8,
        "total_timesteps": 16_000,
        "eval": {"every_steps": 4_000, "episodes": 2},
        "algo_kwargs": {"n_steps": 64, "batch_size": 128, "n_epochs": 2},
    }
    result = train("Clock", settings, envs=write_module("clock.py", CLOCK), check=False)
    found = {each.id: each for each in diagnose(result.run)}
    assert found["Q9"].grade == Grade.WARNING
    assert "all episodes end at step 50, and all are reported as terminated, none as truncated" in found["Q9"].evidence


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_healthy_training_is_silent(train, seed):
    result = train("reach", {"seed": seed}, check=False)
    assert diagnose(result.run) == []
