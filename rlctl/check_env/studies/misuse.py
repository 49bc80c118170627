"""Does what no learner should do: steps too early and too late, and closes twice. Each in a study of its own, since
each may break the environment, or end the process."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.actions import actions
from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.failures import EnvironmentRaised, describe
from rlctl.check_env.instance import Instance
from rlctl.check_env.leaves import Leaf, leaf_name, pick
from rlctl.check_env.legacy import result, skip
from rlctl.check_env.messages import Message
from rlctl.check_env.recording import Plan, Recording
from rlctl.check_env.results import AfterEnd, AfterEndProblem, CloseTwice, StepBeforeReset

LONGEST_EPISODE = 2_000
"""An episode that does not end within so many random steps is left [steps]."""
STEPS_AFTER = 5
"""A body that falls on for a few steps leaves its space by little; what does so by more than its width in these is no
physics any more [steps]."""


def step_before_reset(context: Context) -> Iterator[Message]:
    """Step an instance that was never reset."""
    with context.fresh() as instance:
        try:
            instance.call("step", instance.env.step, _action(instance), step=1)
        except EnvironmentRaised as error:
            yield result(StepBeforeReset(_told(error)))
        else:
            yield result(StepBeforeReset(None))


def close_twice(context: Context) -> Iterator[Message]:
    """Close an instance, and close it again."""
    instance = context.build()
    if not hasattr(instance.env, "close"):
        yield skip("close twice", "it has no close")
        return
    keywords = {"seed": FIRST_SEED} if instance.accepts_seed else {}
    instance.call("reset", instance.env.reset, **keywords)
    instance.close()
    try:
        instance.close()
    except EnvironmentRaised as error:
        yield result(CloseTwice(_told(error)))
    else:
        yield result(CloseTwice(None))


def _action(instance: Instance) -> Any:
    return instance.call("sample", next, actions(instance.env.action_space, "random", FIRST_SEED))


def _told(error: EnvironmentRaised) -> str:
    return describe(error.__cause__ or error)


def after_end(context: Context) -> Iterator[Message]:
    """Live an episode to its end, and step on."""
    instance, budget = context.instance, context.budget
    plan = Plan("after the end", 0, FIRST_SEED, max_steps=LONGEST_EPISODE, max_s=budget.seconds_left / 2)
    lived = Recording(instance, plan, budget)
    lived.reset()
    while lived.running:
        lived.step()
    if lived.failure is not None or lived.was_cut:
        yield skip("after the end", "the episode did not come to an end")
        return
    rewards: list[float] = []
    problems: list[AfterEndProblem] = []
    steps, raised = 0, None
    chosen = actions(instance.env.action_space, "random", FIRST_SEED)
    for step in range(lived.steps + 1, lived.steps + STEPS_AFTER + 1):
        try:
            returned = instance.call("step", instance.env.step, instance.call("sample", next, chosen), step=step)
        except EnvironmentRaised as error:
            raised = _told(error)
            break
        if not isinstance(returned, tuple) or len(returned) < 2:
            break  # is RL201's matter
        steps += 1
        observation, reward = returned[:2]
        problems += [*_problems(instance.leaves, observation, step), *_reward_problems(reward, step, rewards)]
    yield result(AfterEnd(FIRST_SEED, lived.steps, steps, raised, rewards, problems))


def _reward_problems(reward: Any, step: int, rewards: list[float]) -> Iterator[AfterEndProblem]:
    try:
        number = float(reward)
    except Exception:  # its type is another rule's matter
        return
    if np.isfinite(number):
        rewards.append(number)
    else:
        yield AfterEndProblem("not finite", "the reward", step, str(number), "a finite number")


def _problems(leaves: list[Leaf], observation: Any, step: int) -> Iterator[AfterEndProblem]:
    for leaf in leaves:
        if not leaf.supported:
            continue
        name = leaf_name(leaf)
        try:
            values = np.asarray(pick(observation, leaf.path))
        except Exception:  # another structure, or an object of its own kind
            values = np.empty((), object)
        if values.dtype.kind not in "biuf" or values.shape != leaf.shape:
            yield AfterEndProblem("shape", name, step, str(values.shape), str(leaf.shape))
        elif not np.isfinite(values).all():
            wrong = values[~np.isfinite(values)]
            yield AfterEndProblem("not finite", name, step, str(wrong.flat[0]), "a finite number")
        else:
            yield from _outside(leaf, values.astype(np.float64), step)


def _outside(leaf: Leaf, values: NDArray[np.float64], step: int) -> Iterator[AfterEndProblem]:
    """Yield a value that is farther outside its bounds than these are apart."""
    low, high = np.asarray(leaf.low, np.float64), np.asarray(leaf.high, np.float64)
    with np.errstate(invalid="ignore"):
        excess = np.maximum(low - values, values - high) - (high - low)
    place = int(np.nan_to_num(excess, nan=-1.0, neginf=-1.0, posinf=-1.0).argmax())
    if np.ravel(excess)[place] > 0:
        bounds = f"[{np.ravel(low)[place]:g}, {np.ravel(high)[place]:g}]"
        yield AfterEndProblem("outside", leaf_name(leaf), step, f"{values.flat[place]:g}", bounds)
