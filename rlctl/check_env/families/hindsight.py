"""RL614: rewards that are computed afterwards, for other goals than those that were pursued."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.context import Context
from rlctl.check_env.episode import Episode
from rlctl.check_env.experiment import experiment
from rlctl.check_env.failures import EnvironmentRaised, describe
from rlctl.check_env.finding import Finding, NotApplicable, NotJudged, Severity
from rlctl.check_env.messages import FIRST_SEED, Message

STEPS = 50
TOLERANCE = 1e-4
"""Difference between two rewards, relative to the larger one or to 1, up to which it is rounding to float32."""
GOALS = ("achieved_goal", "desired_goal")


@experiment("hindsight", "RL614", share=0.3)
def recompute_rewards(context: Context) -> Iterator[Message]:
    """Ask for the rewards of steps that have just been rewarded, one by one and all at once."""
    instance = context.instance
    compute = getattr(getattr(instance.env, "unwrapped", instance.env), "compute_reward", None)
    leaves = {leaf.path for leaf in instance.leaves}
    if not callable(compute) or not leaves >= {(name,) for name in GOALS}:
        raise NotApplicable("no compute_reward, or no goals in the observation that are arrays")
    episode = Episode(instance, FIRST_SEED, max_steps=STEPS, deadline=context.budget.deadline)
    taken = [(each.observation, each.info, float(each.reward)) for each in episode if each.step]
    if not taken:
        raise NotJudged("no step could be taken")
    goals = [np.stack([np.asarray(observation[name]) for observation, *_ in taken]) for name in GOALS]
    infos = np.array([info for _, info, _ in taken])
    given = np.array([reward for *_, reward in taken])
    what = "a single reward"
    try:
        pairs = zip(*goals, infos, strict=True)
        alone = [instance.call("compute_reward", _call, np.asarray, compute, *pair) for pair in pairs]
        singles = np.array([instance.call("compute_reward", _to_number, each) for each in alone])
        what = "all rewards at once"
        batch = instance.call("compute_reward", _call, np.asarray, compute, *goals, infos)
    except EnvironmentRaised as error:
        raised = describe(error.__cause__ or error)
        yield Finding("RL614", f"compute_reward: {what} raises {raised}", {"steps": len(taken)})
        return
    if shape := alone[0].shape:
        message = f"compute_reward: of one goal it returns an array of shape {shape}, not a number"
        yield Finding("RL614", message, {"steps": len(taken)}, Severity.WARNING)
    if batch.shape != given.shape:
        shapes = f"of {len(taken)} goals at once it returns shape {batch.shape}, not {given.shape}"
        yield Finding("RL614", f"compute_reward: {shapes}", {"steps": len(taken)})
    elif not np.allclose(batch, singles, rtol=1e-4, atol=1e-5):
        message = "compute_reward: of many goals at once it returns other rewards than one by one"
        yield Finding("RL614", message, {"steps": len(taken)})
    off = np.abs(singles - given)
    step = int(off.argmax())
    if off[step] > TOLERANCE * max(1.0, abs(given[step]), abs(singles[step])):
        message = f"the reward of step {step + 1} is {given[step]:.6g}, and compute_reward says {singles[step]:.6g}"
        evidence = {"step": step + 1, "value": float(singles[step]), "expected": float(given[step])}
        yield Finding("RL614", message, evidence)


def _to_number(value: NDArray[Any]) -> float:
    return float(value.item())


def _call(convert: Callable[[Any], Any], compute: Callable[..., Any], *arguments: Any) -> Any:
    return convert(compute(*arguments))
