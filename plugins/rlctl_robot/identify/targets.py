"""The last targets of a task whose actions are steps of them: reads them, and leads them to those of a robot."""

import numpy as np

from rlctl.task.env import TaskEnv
from rlctl_robot.identify.log import Array

_CLOSE = 1e-6  # [rad or m], between a target and where it is to be


def remembers_targets(env: TaskEnv) -> bool:
    """Return whether actions are steps of targets that the task remembers, not of the measured positions."""
    described = env.task.describe_joints()
    if described is None or not described.action_step:
        return False
    env.reset(seed=0)
    before = read_targets(env)
    for end in (env.action_space.low, env.action_space.high):  # type: ignore[attr-defined]
        env.act(end)  # without simulated time, so the joints do not move
        if not np.array_equal(before, read_targets(env)):
            return True
    return False


def read_targets(env: TaskEnv) -> Array:
    """Return what the task observes, or computes a term from, under the name that its joints give as `measured`."""
    described = env.task.describe_joints()
    assert described is not None
    name, observed = described.measured, env.observe_quantities()
    for term_name, term in env.task.observation_terms.items():
        if name in term.inputs:
            value = observed[term_name]
            return np.ravel(value[term.inputs.index(name)] if isinstance(value, tuple) else value).copy()
    return np.ravel(observed[name]).copy()


def lead_targets(env: TaskEnv, wanted: Array) -> None:
    """Let the task remember other targets, by actions for which no time is simulated, as near as its limits allow."""
    described = env.task.describe_joints()
    assert described is not None
    low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
    total = np.inf
    while True:
        distance = wanted - read_targets(env)
        total, last = float(np.abs(distance).sum()), total
        if total < _CLOSE or total >= last:
            return
        action = np.clip((distance / described.action_step).reshape(low.shape), low, high)
        env.act(action.astype(low.dtype))
