"""RL629: grasp is paid on air."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.action_trials import ActionNumber, Trials, find_dimensions
from rlctl.checking.episode import EpisodePlayer, zero_action
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.term_names import is_about_grasps, is_paid
from rlctl.checking.values import find_numbers
from rlctl.checking.workspaces import Numbers, find_objects

RULE = Rule(
    "RL629",
    "grasp is paid on air",
    Severity.WARNING,
    meaning="""
        A reward term for a grasp pays when the gripper closes, wherever the object is. The check moved the arm at
        random, then gave the zero action and closed the gripper, and in the same episodes opened it: closing earned the
        term in all of them, and no object was moved. The policy learns to close the gripper at once, and has no reason
        to go to the object.
    """,
    fix="""
        Pay the grasp only while both fingers touch the object, or while it is between them: multiply by whether the
        distance of the gripper to the object is small.
    """,
)

SEEDS, MOST_SEEDS = 5, 12
ARM_STEPS, HOLD_STEPS = 6, 14  # with a random action; with the gripper closed or open
MUCH = 0.2  # part of the largest term that closing has to earn
SAME, SAME_REWARD = 0.25, 0.5  # relative differences of what it earns in different episodes, of the term and in all
MOVED = 0.01  # of an object [m]
MOST_DIMENSIONS = 9


@experiment("grasps", PROBE, 108, RULE, share=0.3, seeds_globals=True, alters=True)
def close_on_air(context: Context) -> Iterator[ChildMessage]:
    """Close and open the gripper away from the object."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    names = _find_terms(instance)
    dimensions = find_dimensions(instance.action_leaves)
    if not names or not dimensions:
        raise NotApplicable("no reward term in info is called after a grasp")
    for dimension in reversed(dimensions[-MOST_DIMENSIONS:]):  # a gripper comes last
        for name in names:
            gains = _measure_gains(instance, dimension, name)
            if gains is not None:
                message = (
                    f"{name} pays {np.mean(gains):.3g} more with {dimension.name} held at one end than at the other,"
                )
                message += (
                    f" wherever random actions moved the arm before, in {SEEDS} of {SEEDS} episodes; no object moved"
                )
                yield RuleFinding(RULE, message, {"term": name, "value": float(np.mean(gains)), "expected": 0.0})
                return


def _find_terms(instance: Instance) -> list[str]:
    names: list[str] = []
    for moment in EpisodePlayer(instance, FIRST_SEED, "zero", max_steps=1):
        if moment.step and isinstance(moment.info, dict):
            names = [name for name, _ in find_numbers(moment.info) if is_paid(name) and is_about_grasps(name)]
    return names


def _measure_gains(instance: Instance, dimension: ActionNumber, name: str) -> list[float] | None:
    """Return what one end of an element of the action earns more than the other, in several episodes in which no object
    was moved; None where it is not about the same in all, or there are too few."""
    gains: list[float] = []
    rewards: list[float] = []  # what it earns more in all
    for seed in range(FIRST_SEED, FIRST_SEED + MOST_SEEDS):
        ends = [_play(instance, seed, dimension, end, name) for end in dimension.ends]
        if any(end is None for end in ends):
            continue
        (low, low_reward), (high, high_reward) = (end or (0.0, 0.0) for end in ends)
        gains.append(high - low)
        rewards.append(high_reward - low_reward)
        if max(low, high) <= 0 or abs(gains[-1]) <= MUCH * max(abs(low), abs(high)):
            return None
        if len(gains) == SEEDS:
            break
    if len(gains) < SEEDS or not _are_alike(gains, SAME):
        return None
    # A number in info may be a factor of the reward, which is paid at the object only.
    is_paid = _are_alike(rewards, SAME_REWARD) and rewards[0] * gains[0] > 0
    return np.abs(gains).tolist() if is_paid else None


def _are_alike(gains: Sequence[float], most: float) -> bool:
    sizes = np.abs(gains)
    return len({gain > 0 for gain in gains}) == 1 and bool(np.ptp(sizes) <= most * sizes.max())


def _play(
    instance: Instance, seed: int, dimension: ActionNumber, value: float, name: str
) -> tuple[float, float] | None:
    """Return what the term and the whole reward pay at the end; None where the episode ends before, or an object was
    moved."""
    trials = Trials(instance)
    sequence = _list_actions(trials, seed, dimension, value)
    paid, reward = None, 0.0
    before: dict[str, Numbers] = {}
    for moment in EpisodePlayer(instance, seed, sequence=sequence, max_steps=len(sequence)):
        if moment.step == ARM_STEPS:
            before = _read_objects(instance)
        if moment.step == len(sequence):
            paid, reward = dict(find_numbers(moment.info)).get(name), moment.reward_number
    after = _read_objects(instance)
    is_moved = any(np.abs(after[body] - place).max() > MOVED for body, place in before.items() if body in after)
    return None if is_moved or paid is None else (float(paid), reward)


def _read_objects(instance: Instance) -> dict[str, Numbers]:
    objects = find_objects(instance.env, instance.find_clients())
    return {name: one.read() for name, one in objects.items()}


def _list_actions(trials: Trials, seed: int, dimension: ActionNumber, value: float) -> list[Any]:
    moving = [trials.change(action, {dimension: dimension.ends[0]}) for action in trials.actions(seed, ARM_STEPS)]
    held = trials.change(zero_action(trials.instance.env.action_space), {dimension: value})
    return [*moving, *[held] * HOLD_STEPS]
