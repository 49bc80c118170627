"""RL614: hindsight reward differs."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context, EnvironmentRaised
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity

RULE = Rule(
    "RL614",
    "hindsight reward differs",
    Severity.ERROR,
    meaning="""
        compute_reward gives another reward than step did, or cannot take many goals at once. Hindsight
        experience replay (HER) takes most of its rewards from there, and so learns another task.
    """,
    fix="""
        Let step() return float(self.compute_reward(achieved_goal, desired_goal, info)), and write
        compute_reward for arrays: -np.linalg.norm(achieved_goal - desired_goal, axis=-1).
    """,
)

STEPS = 50
TOLERANCE = 1e-4  # relative to the reward or to 1: rounding to float32
GOALS = ("achieved_goal", "desired_goal")


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
    try:
        computed = instance.call("compute_reward", lambda: np.asarray(compute(*goals, infos), np.float64))
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
