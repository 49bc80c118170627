"""RL6: the reward as a number, its terms in `info["reward_terms"]`, and for other goals (RL601-603, 612, 614)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.episode import Episode
from rlctl.check_env.experiment import check, experiment
from rlctl.check_env.failures import EnvironmentRaised, describe
from rlctl.check_env.finding import Finding, NotApplicable, NotJudged, Severity
from rlctl.check_env.instance import Context
from rlctl.check_env.messages import FIRST_SEED, Message
from rlctl.check_env.records import Records
from rlctl.check_env.rewarded import (
    WITH_SEARCH,
    find_constant_terms,
    has_succeeded,
    require_rewarded,
    require_terms,
    summarize,
)

LARGE = 10.0
"""Root mean square per step from which a reward is large. With the usual discount a return is up to a hundred times
as much, and value networks begin near 0. Pendulum's rewards, down to -16, are below it."""
HUGE = 1_000.0
"""A single reward beyond this, ten times the usual bonus for finishing, spoils the value estimate of all before it."""
MEANT_CONSTANT = re.compile(
    r"(^|_)(alive|aliveness|surviv\w*|time|steps?|living|life|exist\w*|constant|bias)(_|$)", re.I
)
"""Names of terms that are meant to be the same at every step."""
STEPS = 50
TOLERANCE = 1e-4
"""Difference between two rewards, relative to the larger one or to 1, up to which it is rounding to float32."""
GOALS = ("achieved_goal", "desired_goal")


@check("RL601")
def find_not_finite(records: Records) -> Iterator[Finding]:
    """Find the first reward that is NaN or infinite."""
    for episode in records.require_alone():
        wrong = np.flatnonzero(~np.isfinite(episode.rewards) & episode.reward_is_number)
        if wrong.size:
            step, value = int(wrong[0]) + 1, str(episode.rewards[wrong[0]])
            evidence = episode.at(step, value=value, expected="finite")
            yield Finding("RL601", f"the reward is {value} at step {step}", evidence)
            return


@check("RL602", *WITH_SEARCH)
def _find_constant_reward(records: Records) -> Iterator[Finding]:
    episodes = require_rewarded(records)
    constant = float(episodes[0].rewards[0])
    if any((each.rewards != constant).any() or each.terminated.any() for each in episodes):
        return
    at_success = any(has_succeeded(each) for each in episodes)
    also = ", also where is_success is true" if at_success else ""
    yield Finding(
        "RL602",
        f"the reward is {constant:g} at every step of {summarize(episodes)}{also}, and nothing ends an episode early",
        {"value": constant, "episodes": len(episodes), "steps": sum(each.steps for each in episodes)},
        Severity.WARNING if constant > 0 or at_success else Severity.INFO,
    )


@check("RL603")
def _find_badly_scaled(records: Records) -> Iterator[Finding]:
    require_rewarded(records)
    episodes = [each for each in records.episodes if each.steps]
    if not episodes:
        return
    inner = np.concatenate([each.rewards[: each.steps - each.has_ended] for each in episodes])
    size = float(np.sqrt(np.mean(inner**2))) if inner.size else 0.0
    largest = max(episodes, key=lambda each: float(np.abs(each.rewards).max()))
    step = int(np.abs(largest.rewards).argmax())
    value = float(largest.rewards[step])
    if size > LARGE:
        message = f"the reward per step is {size:.3g} (root mean square), up to {value:.3g}"
    elif abs(value) > HUGE:
        message = f"the reward is {value:.3g} at step {step + 1}; usual is {size:.2g}"
    else:
        return
    evidence = largest.at(step + 1, value=value, root_mean_square=size, expected=[-LARGE, LARGE])
    yield Finding("RL603", message, evidence, Severity.INFO if records.normalizes_rewards() else Severity.WARNING)


@check("RL612", *WITH_SEARCH)
def _find_constant_penalty(records: Records) -> Iterator[Finding]:
    episodes = require_terms(records)
    for name, value in find_constant_terms(episodes).items():
        if value < 0 and not MEANT_CONSTANT.search(name):
            message = f"reward term {name!r} is {value:.6g} at every step of {summarize(episodes)}"
            yield Finding("RL612", message, {"term": name, "value": value, "episodes": len(episodes)})


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
