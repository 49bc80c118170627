"""RL614: hindsight reward differs."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context, EnvironmentRaised, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity

RULE = Rule(
    "RL614",
    "hindsight reward differs",
    Severity.ERROR,
    meaning="""
        compute_reward gives another reward than step did, cannot take many goals at once, or gives the same
        whatever desired_goal it is asked for, as where it reads the environment's own goal. Hindsight experience
        replay (HER) takes most of its rewards from there, and so learns another task. A warning where it pays more for
        another desired goal than for the one that is achieved exactly: a part of the error has a wrong sign.
    """,
    fix="""
        Let step() return float(self.compute_reward(achieved_goal, desired_goal, info)), and write
        compute_reward for arrays, of its arguments only:
        -np.linalg.norm(achieved_goal - desired_goal, axis=-1).
    """,
)

STEPS = 50
TOLERANCE = 1e-4  # relative to the reward or to 1: rounding to float32
GOALS = ("achieved_goal", "desired_goal")
LEAST = 1e-9  # differences of rewards that count, relative to the reward or to 1
RESETS = 6  # that draw other goals to ask for
MOSTLY = 0.6  # part of the achieved goals that have to earn less than others
CLEARLY, UNIT = 0.02, 1e-4  # part of the rewards' range; how far from 1 the length of a direction may be
SIGNS = """
    Let reward be largest where achieved_goal is desired_goal: compare each element with its own, as in the cosine of
    an angle's error, which is cos(a) * cos(b) + sin(a) * sin(b).
"""
Rows = NDArray[Any]


@experiment("hindsight", PROBE, 90, RULE, share=0.3)
def recompute_rewards(context: Context) -> Iterator[ChildMessage]:
    """Ask for the rewards of steps that have just been rewarded, all at once, as hindsight replay does."""
    instance = context.instance
    compute = getattr(getattr(instance.env, "unwrapped", instance.env), "compute_reward", None)
    leaves = {leaf.path for leaf in instance.leaves}
    if not callable(compute) or not leaves >= {(name,) for name in GOALS}:
        raise NotApplicable("no compute_reward, or no goals in the observation that are arrays")
    episode = EpisodePlayer(instance, FIRST_SEED, max_steps=STEPS)
    taken = [moment for moment in episode if moment.step and moment.is_readable]
    if not taken:
        raise NotJudged("no step could be taken")
    try:
        goals = [np.stack([np.asarray(moment.observation[name]) for moment in taken]) for name in GOALS]
        rewards = np.array([float(moment.reward) for moment in taken])
        infos = np.array([moment.info for moment in taken])
    except (LookupError, TypeError, ValueError):
        raise NotJudged("goals are missing or change their shape (RL101), or types are wrong (RL204)") from None
    ask = functools.partial(_ask, instance, compute)
    try:
        computed = ask(goals[0], goals[1], infos)
    except EnvironmentRaised as error:
        message = f"compute_reward, of many goals at once, raises {error}"
        yield RuleFinding(RULE, message, {"steps": len(taken)})
        return
    if computed.shape != rewards.shape:
        message = f"compute_reward of {len(taken)} goals at once returns shape {computed.shape}, not {rewards.shape}"
        yield RuleFinding(RULE, message, {"steps": len(taken)})
        return
    off = np.abs(computed - rewards)
    # Written so that NaN is another reward; where the environment itself gives one, RL601 says so.
    is_other = np.isfinite(rewards) & ~(off <= TOLERANCE * np.maximum(1.0, np.abs(rewards)))
    if is_other.any():
        step = int(np.where(is_other, off, 0.0).argmax())
        returned = f"compute_reward returns {computed[step]:.6g}"
        message = f"the reward of step {step + 1} is {rewards[step]:.6g}, and {returned}"
        evidence = {"step": step + 1, "value": float(computed[step]), "expected": float(rewards[step])}
        yield RuleFinding(RULE, message, evidence)
    else:
        ignored = list(_find_ignored_goal(instance, ask, goals[0], infos))
        yield from ignored or _find_better_goals(instance, ask, goals[0], infos)


def _ask(instance: Instance, compute: Callable[..., Any], achieved: Rows, desired: Rows, infos: Rows) -> Rows:
    return np.asarray(
        instance.call("compute_reward", lambda: np.asarray(compute(achieved, desired, infos), np.float64))
    )


def _find_ignored_goal(
    instance: Instance, ask: Callable[..., Rows], achieved: Rows, infos: Rows
) -> Iterator[RuleFinding]:
    """Ask for the rewards of single steps with many goals: those that resets draw, and all that were achieved, as
    hindsight replay does."""
    try:
        desired = np.concatenate([achieved, _draw_goals(instance)])
    except (LookupError, TypeError, ValueError):
        return  # a goal is missing or has another shape, which RL101 reports
    if (desired == desired[0]).all():
        return
    for row in (len(achieved) // 2, len(achieved) - 1):
        same = [row] * len(desired)
        rewards = ask(achieved[same], desired, infos[same])
        if rewards.shape != (len(desired),) or np.ptp(rewards) > LEAST * max(1.0, abs(rewards[0])):
            return
    message = f"compute_reward does not depend on desired_goal: the reward of step {row + 1} is {rewards[0]:.6g}"
    message += f" with each of {len(desired)} goals, also with what was achieved"
    yield RuleFinding(RULE, message, {"element": "desired_goal", "step": row + 1, "value": float(rewards[0])})


def _find_better_goals(instance: Instance, ask: Callable[..., Rows], last: Rows, infos: Rows) -> Iterator[RuleFinding]:
    """Ask for the rewards of achieved goals where just they are desired, and where a part of the desired goal is
    another one: of the first ones of some episodes, and of the last one of the steps that were taken."""
    if last.ndim != 2 or last.dtype.kind != "f":
        return
    achieved, drawn = np.vstack([_draw_goals(instance, "achieved_goal"), last[-1:]]), _draw_goals(instance)
    beaten: list[tuple[float, float, Rows, Rows]] = []
    for goal in achieved:
        others = np.array(list(_mix(goal, drawn)))
        desired = np.vstack([goal, others])
        own, *rewards = ask(np.array([goal] * len(desired)), desired, infos[[0] * len(desired)]).tolist()
        best = int(np.argmax(rewards))
        if rewards[best] > own + CLEARLY * max(LEAST, float(np.ptp([own, *rewards]))):
            beaten.append((own, rewards[best], goal, others[best]))
    if len(beaten) >= MOSTLY * len(achieved):
        own, best_reward, goal, other = max(beaten, key=lambda one: one[1] - one[0])
        texts = [np.round(numbers, 3).tolist() for numbers in (goal, other)]
        message = f"compute_reward returns {own:.4g} where achieved_goal {texts[0]} is just what is desired, and"
        message += f" {best_reward:.4g} where {texts[1]} is; so it is with {len(beaten)} of {len(achieved)} goals"
        evidence = {"element": "desired_goal", "value": own, "expected": f"at least {best_reward:.6g}"}
        yield RuleFinding(RULE, message, evidence, Severity.WARNING, " ".join(SIGNS.split()))


def _mix(goal: Rows, drawn: Rows) -> Iterator[Rows]:
    """Yield other goals, and those of which the first or the last elements are other ones; without what breaks a
    direction that all goals have, whose length is 1."""
    every = np.vstack([goal, drawn])
    units = [
        slice(first, first + size)
        for size in (2, 3, 4)
        for first in range(goal.size - size + 1)
        if np.abs(np.linalg.norm(every[:, first : first + size], axis=1) - 1).max() < UNIT
    ]
    for other in drawn:
        for cut in range(goal.size):
            for one, two in ((goal, other), (other, goal)):
                mixed = np.concatenate([one[:cut], two[cut:]])
                if all(abs(np.linalg.norm(mixed[unit]) - 1) < UNIT for unit in units):
                    yield mixed


def _draw_goals(instance: Instance, name: str = "desired_goal") -> Rows:
    """Return the goals that other seeds draw, or what is achieved then. Shape (RESETS, *goal)."""
    seeds = range(FIRST_SEED + 1, FIRST_SEED + 1 + RESETS)
    starts = [EpisodePlayer(instance, seed, max_steps=0).reset() for seed in seeds]
    return np.stack([np.asarray(start.observation[name]) for start in starts])
