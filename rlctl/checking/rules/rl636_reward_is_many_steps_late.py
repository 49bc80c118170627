"""RL636: reward is many steps late."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from rlctl.checking.action_trials import REWARD, Frame, Trials, find_differences
from rlctl.checking.experiments.action_effects import ActionTrials, judges_actions
from rlctl.checking.records import FIRST_SEED, SECOND_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.values import flatten_action

RULE = Rule(
    "RL636",
    "reward is many steps late",
    Severity.WARNING,
    meaning="""
        One changed action changes the observation at once, and all that is observed has answered a few steps later.
        The reward, but for what the action itself costs, answers only many steps later, after the same number of steps
        in each episode and wherever the action is changed. It is computed from an old entry of a history, such as
        history[0] instead of history[-1]. The policy is paid for what it did long ago, and learns the wrong actions.
    """,
    fix="Compute the reward from the newest entry; of a deque with appended entries that is [-1].",
)

STEPS = 48  # of an episode
FORKS = ((FIRST_SEED, 0), (FIRST_SEED, 5), (SECOND_SEED, 3), (SECOND_SEED + 1, 8))
"""Seeds, and the steps before which the changed actions are."""
COSTS = 2  # steps in which a reward answers to the action itself, and to its change
LEAST = 3  # steps that a reward is late
MOSTLY = 0.8  # part of the steps in which a late reward answers once it does
FEWEST_AFTER = 6  # steps in which it does
ROUNDING = 1e-9


@dataclasses.dataclass(frozen=True)
class _Answers:
    """How many steps after a changed action something answers; 1 is the step of the action."""

    observation: int  # by which all has answered that does
    reward: int


@judges_actions(RULE)
def _find_late_reward(shown: ActionTrials) -> Iterator[RuleFinding]:
    found: set[int] = set()
    observed = 0
    for seed, at in FORKS:
        answers = _measure(shown, seed, at)
        if answers is None or answers.reward - answers.observation < LEAST:
            return
        found.add(answers.reward)
        observed = max(observed, answers.observation)
    if len(found) == 1:
        late = found.pop() - 1
        message = f"a changed action changes all that is observed within {observed} steps, and the reward, but for what"
        message += f" the action costs, {late} steps after its own step, in {len(FORKS)} of {len(FORKS)} episodes: the"
        message += f" reward is {late} steps late"
        yield RuleFinding(RULE, message, {"seed": FIRST_SEED, "step": late + 1, "value": late, "expected": 0})


def _measure(shown: ActionTrials, seed: int, at: int) -> _Answers | None:
    """Return when an episode answers to an action at the other end of its range; None where that cannot be told."""
    trials = shown.trials
    plain, changed = trials.plain(seed, STEPS), _change(shown, trials, seed, at)
    differences = find_differences(plain, changed, ROUNDING)
    if any(step <= at for step in differences):  # by what an episode has left over, and not by the action
        return None
    steps = np.array([step - at for step, columns in differences.items() if REWARD in columns and step > at + COSTS])
    last = min(len(plain), len(changed)) - 1 - at
    if not steps.size or last - steps[0] < FEWEST_AFTER or len(steps) < MOSTLY * (last - steps[0] + 1):
        return None
    first: dict[int, int] = {}
    for step in sorted(differences):
        for column in differences[step].tolist():
            if column < REWARD:
                first.setdefault(column, step - at)
    reward = int(steps[0])
    if not first or {reward, reward - 1} & set(first.values()):  # what is observed may be as old
        return None
    return _Answers(max(step for step in [0, *first.values()] if step < reward), reward)


def _change(shown: ActionTrials, trials: Trials, seed: int, at: int) -> list[Frame]:
    """Play an episode in which all numbers of one action are at that end of their range which is farther away."""
    chosen = trials.actions(seed, STEPS)
    numbers = flatten_action(trials.instance.action_leaves, chosen[at])
    values = {}
    for one in shown.dimensions:
        low, high = one.ends
        values[one] = low if abs(low - numbers[one.column]) > abs(high - numbers[one.column]) else high
    chosen[at] = trials.change(chosen[at], values)
    return trials.play(seed, chosen)
