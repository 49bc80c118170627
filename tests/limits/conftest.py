"""Environments, as policies describe them, limits for them, and how examples are generated."""

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import HealthCheck, Phase, settings

from rlctl.deploy import Limits, SafetyFilter
from rlctl.environments.info import EnvInfo, space_to_json

JOINTS = ["shoulder", "elbow"]
# Without the phase of targets, for which hypothesis loads a module amid a test: Python 3.11 can fail to compile one
# while it collects garbage ("AST constructor recursion depth mismatch").
REPEATABLE = settings(
    deadline=None,
    derandomize=True,
    phases=(Phase.generate, Phase.shrink),
    suppress_health_check=[HealthCheck.too_slow],
)
"""The same examples each time, however slow the machine is."""


@pytest.fixture
def arm():
    """An arm of two joints that observes their positions and a goal; a control step takes 0.1 s."""
    return make_arm()


def make_arm(low=-10.0, high=10.0):
    return EnvInfo(
        observation_space=space_to_json(spaces.Box(-np.inf, np.inf, (5,), np.float32)),
        action_space=space_to_json(spaces.Box(low, high, (2,), np.float32)),
        observation_sizes={"positions": 2, "goal": 3},
        control_dt=0.1,
    )


def observe_at(*positions):
    return np.array([*positions, 0.0, 0.0, 0.0], np.float32)


def make_filter(info, **limits):
    limits = {"joints": JOINTS, "measured": {"position": "positions"}, **limits}
    return SafetyFilter(info, Limits.model_validate(limits), clock=lambda: 7.0)


def run_filter(safety, observation, action):
    safety.observe(observation)
    return safety.limit(action if safety.trusts_observation else None)
