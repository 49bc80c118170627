"""RL638: the reward follows another goal than the observation."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.action_trials import REWARD, Frame, Trials
from rlctl.checking.experiment import INSTANCES, experiment
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.first_goals import FirstGoals
from rlctl.checking.instance import Context, EnvironmentRaised, Instance
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.stale_values import StaleValues
from rlctl.checking.term_names import is_place
from rlctl.checking.values import Attribute, find_unequal, read_attributes, shape_like

RULE = Rule(
    "RL638",
    "reward follows another goal",
    Severity.WARNING,
    meaning="""
        reset draws several goals, one after the other, and for a while the observation shows one of them and the
        reward pays for another: a policy that does what it sees earns nothing. One goal after the other was replaced
        while the same episode was played: in the same steps only one of them changed the observations, and only
        another one changed the rewards. Or reset copies a goal or a command into another attribute, and steps still
        read the copy after another one was drawn: the check let the condition be true under which that happens. Or only
        the first reset computes a value, as under `if self.goal is None`, from another one that each reset sets. Or a
        line reads the first of several goals, where others read the one that a counter or a clock says.
    """,
    fix="Choose the goal in one place, which the observation, the reward and the success read.",
)

MOST_GOALS, MOST_GROUPS = 6, 3
LONGEST = 400  # steps of an episode that are compared
FEWEST = 10  # steps in a row; a reward may belong to the goal that was seen before the step
SAME = 1e-6  # differences that do not count, of the numbers or of 1


@judges_expressions(RULE, decides=False)
def _find_stale_copies(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    stale = noted.share(StaleValues)
    for one in stale.find_stale_copies():
        message = f"reset copies {one.goal} into {one.copy}, which steps still read after {one.goal} has changed:"
        message += f" {one.read.text} is then that of the last {one.goal}"
        yield RuleFinding(RULE, message, {"element": one.copy}, where=one.read.where)
    for one in stale.find_first_only():
        message = f"only the first reset computes {one.copy} from {one.goal}, and each reset sets another {one.goal}:"
        message += f" {one.read.text} is that of the first episode"
        yield RuleFinding(RULE, message, {"element": one.copy}, where=one.read.where)
    for one in FirstGoals(noted).find():
        message = f"{one.read.text} stays that of the first goal, while {one.goal} goes on to the next ones"
        yield RuleFinding(RULE, message, {"element": one.copy}, where=one.read.where)


@dataclasses.dataclass(frozen=True)
class _Goal:
    """One of several goals that a reset draws."""

    attribute: Attribute  # as another seed draws it
    elements: tuple[int, ...]
    name: str

    def assign(self, instance: Instance) -> None:
        """Replace this goal, and no other, by that of the other seed."""
        attribute = read_attributes(instance.env)[self.attribute.name]
        numbers = attribute.numbers.copy()
        numbers[list(self.elements)] = self.attribute.numbers[list(self.elements)]
        attribute.assign(shape_like(attribute.value, numbers))


@experiment("other goals", INSTANCES, 71, RULE, alters=True)
def exchange_goals(context: Context) -> Iterator[ChildMessage]:
    """Play one episode again and again, each time with one of its goals as reset drew it for another seed."""
    with context.fresh() as instance:
        groups = _find_groups(instance)
        if not groups:
            raise NotApplicable("reset draws no goals of which one comes after the other")
        trials = Trials(instance)
        trials.require_repeatable()
        steps = min(instance.max_steps or LONGEST, LONGEST)
        plain, again = (_play(instance, trials, steps, None) for _ in range(2))
        if _find_changed(plain, again).any():
            raise NotJudged("equal seeds and actions give unequal episodes (RL3)")
        for goals in groups:
            changed = [_find_changed(plain, _play(instance, trials, steps, goal)) for goal in goals]
            shortest = min(map(len, changed))
            # Shape (goals, steps, 2): what each goal changes, the observation and the reward.
            yield from _compare(goals, np.array([rows[:shortest] for rows in changed]))


def _find_groups(instance: Instance) -> list[list[_Goal]]:
    """Return goals that the seed draws and that may follow each other: the rows of an attribute, or attributes of one
    size."""
    starts = []
    for seed in (FIRST_SEED, FIRST_SEED, SECOND_SEED):
        instance.reset(seed)
        starts.append(read_attributes(instance.env))
    one, again, other = starts
    by_chance = {*find_unequal(one, again)}
    names = [name for name in find_unequal(one, other) if is_place(name) and name not in by_chance]
    groups = [_split(other[name]) for name in names]
    wholes = [_Goal(other[name], tuple(range(other[name].numbers.size)), name) for name in names]
    sizes = sorted({len(whole.elements) for whole in wholes})
    groups += [[whole for whole in wholes if len(whole.elements) == size] for size in sizes]
    return [group[:MOST_GOALS] for group in groups if len(group) > 1][:MOST_GROUPS]


def _split(attribute: Attribute) -> list[_Goal]:
    """Return the rows of an attribute, or the elements of a row of numbers that are the goals of one world."""
    shape = np.shape(attribute.value)
    if len(shape) < 2:
        return []
    rows = shape[0] if shape[0] > 1 else shape[1]
    elements = np.arange(attribute.numbers.size).reshape(rows, -1)
    return [_Goal(attribute, tuple(row.tolist()), f"{attribute.name}[{number}]") for number, row in enumerate(elements)]


def _play(instance: Instance, trials: Trials, steps: int, goal: _Goal | None) -> list[Frame]:
    try:
        after_reset = (lambda: None) if goal is None else (lambda: goal.assign(instance))
        return trials.play(FIRST_SEED, trials.actions(FIRST_SEED, steps), after_reset)
    except (EnvironmentRaised, AttributeError, TypeError, ValueError, KeyError) as error:
        raise NotJudged(f"a goal could not be replaced: {error}") from error


def _find_changed(plain: Sequence[Frame], other: Sequence[Frame]) -> NDArray[np.bool_]:
    """Say for each step whether observation and reward differ. Shape (steps, 2)."""
    rows = []
    for one, two in itertools.islice(zip(plain, other, strict=False), 1, None):
        differ = ~np.isclose(one, two, rtol=SAME, atol=SAME, equal_nan=True)
        rows.append((bool(differ[:REWARD].any()), bool(differ[REWARD])))
    return np.array(rows, np.bool_).reshape(-1, 2)


def _compare(goals: Sequence[_Goal], changed: NDArray[np.bool_]) -> Iterator[RuleFinding]:
    """Yield a finding where one goal alone is seen for a while, and another one alone is paid."""
    alone = changed.sum(axis=0) == 1  # Shape (steps, 2)
    seen, paid = (np.where(alone[:, column], changed[:, :, column].argmax(axis=0), -1) for column in (0, 1))
    first = 0
    for (shown, rewarded), run in itertools.groupby(zip(seen.tolist(), paid.tolist(), strict=True)):
        length = len(list(run))
        if length >= FEWEST and shown != rewarded and min(shown, rewarded) >= 0:
            last = first + length
            message = f"in steps {first + 1} to {last} the observation follows {goals[shown].name} and no other goal,"
            message += f" and the reward {goals[rewarded].name}: what is seen is not what is paid"
            evidence = {"element": goals[rewarded].name, "seed": FIRST_SEED, "step": first + 1}
            yield RuleFinding(RULE, message, evidence)
            return
        first += length
