"""Asks a goal environment for the rewards of steps that it has just rewarded, one by one and all at once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.check_env.actions import actions
from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.failures import EnvironmentRaised, describe
from rlctl.check_env.instance import Instance
from rlctl.check_env.legacy import result
from rlctl.check_env.messages import Message
from rlctl.check_env.results import Hindsight

STEPS = 50


def hindsight(context: Context) -> Iterator[Message]:
    """Live the begin of an episode of an environment that has `compute_reward`, and compare."""
    instance = context.instance
    compute = getattr(getattr(instance.env, "unwrapped", instance.env), "compute_reward", None)
    keys = {leaf.path[0] for leaf in instance.leaves if leaf.path}
    if not callable(compute) or not keys >= {"achieved_goal", "desired_goal"}:
        yield result(Hindsight(False, 0, None, None, None))
        return
    steps = list(_lived(instance, context))
    singles: list[float] = []
    try:
        for achieved, desired, info, _ in steps:
            singles.append(float(instance.call("compute_reward", compute, achieved, desired, info)))
        batch = np.asarray(_at_once(instance, compute, steps))
    except EnvironmentRaised as error:
        cause = error.__cause__ or error
        what = "all rewards at once" if len(singles) == len(steps) else "a single reward"
        yield result(Hindsight(True, len(steps), None, None, f"{what} raises {describe(cause)}"))
        return
    except (TypeError, ValueError) as error:
        yield result(Hindsight(True, len(steps), None, None, f"a single reward is no number: {error}"))
        return
    rewards = np.array([reward for *_, reward in steps])
    difference = np.abs(np.array(singles) - rewards)
    worst = int(difference.argmax()) if steps else 0
    wrong = None
    if batch.shape != rewards.shape:
        wrong = f"of {len(steps)} goals at once it returns shape {batch.shape}, not ({len(steps)},)"
    elif not np.allclose(batch, singles, rtol=1e-4, atol=1e-5):
        wrong = "of many goals at once it returns other rewards than one by one"
    pair = [float(rewards[worst]), singles[worst]] if steps else None
    yield result(Hindsight(True, len(steps), worst + 1, pair, wrong))


def _lived(instance: Instance, context: Context) -> Iterator[tuple[Any, Any, Any, float]]:
    chosen = actions(instance.env.action_space, "random", FIRST_SEED)
    instance.call("reset", instance.env.reset, **({"seed": FIRST_SEED} if instance.accepts_seed else {}))
    for step in range(1, STEPS + 1):
        observation, reward, terminated, truncated, info = instance.call(
            "step", instance.env.step, next(chosen), step=step
        )
        yield np.array(observation["achieved_goal"]), np.array(observation["desired_goal"]), info, float(reward)
        if terminated or truncated or context.budget.seconds_left < 0:
            return


def _at_once(instance: Instance, compute: Any, steps: list[tuple[Any, Any, Any, float]]) -> Any:
    achieved, desired = np.stack([each[0] for each in steps]), np.stack([each[1] for each in steps])
    return instance.call("compute_reward", compute, achieved, desired, np.array([each[2] for each in steps]))
