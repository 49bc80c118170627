"""RL114: something that decides the reward is hidden."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.action_trials import REWARD, Frame, Trials, find_differences
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import INSTANCES, experiment
from rlctl.checking.instance import Context, EnvironmentRaised, Instance
from rlctl.checking.previous_values import is_previous_key
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged, OutOfTime, Rule, RuleFinding, Severity
from rlctl.checking.rules.rl637_progress_is_counted_from_the_start import RULE as FROM_START
from rlctl.checking.values import Attribute, find_assignment, find_unequal, flatten, read_attributes

RULE = Rule(
    "RL114",
    "something that decides the reward is hidden",
    Severity.WARNING,
    meaning="""
        reset draws an attribute, most often the goal or the command, that the reward uses and the observation
        does not show. rlctl changed it: the same episode then had the same observations and other rewards. The
        policy cannot know what to do, and learns the average.
    """,
    fix="Put the goal, or what else reset draws and the reward uses, into the observation.",
)

HIDDEN_STEPS, FEWEST_COMPARED = 20, 5  # How many steps are compared with an attribute changed
MOST_CHANGED = 40  # So many attributes are changed
MOST_OBSERVED = 1_000  # Larger observations are images or scans, in which a goal may be drawn
REGRESSED_RESETS = 60  # Resets over which an attribute is predicted from the observation
SHOWN = 0.9  # part of an attribute's variance that the observation has to explain


@experiment("hidden state", INSTANCES, 70, RULE, FROM_START, share=1.5, seeds_globals=True, alters=True)
def change_attributes(context: Context) -> Iterator[ChildMessage]:
    """Play one episode again and again, each time with one attribute as reset drew it for another seed."""
    with context.fresh() as instance:
        trials = Trials(instance)
        trials.require_repeatable()
        plain = trials.plain(FIRST_SEED, HIDDEN_STEPS)  # known by now
        if plain[0].size > MOST_OBSERVED:
            raise NotApplicable(f"the observation has more than {MOST_OBSERVED} numbers")
        if all(np.array_equal(frame[:REWARD], plain[0][:REWARD]) for frame in plain):
            raise NotApplicable("the observation never changes: a bandit, or RL110")
        for name, other in _find_drawn(instance, trials).items():
            frames = _play_changed(instance, trials, name, other)
            if frames is None or not _hides(plain, frames):
                continue
            if is_previous_key(name):
                yield _count_from_start(instance, name, plain, frames)
            elif _is_shown(instance, name, other.numbers.shape):
                continue
            else:
                yield _hidden(instance, name, plain, frames)
            return


def _find_drawn(instance: Instance, trials: Trials) -> dict[str, Attribute]:
    instance.reset(SECOND_SEED)
    others = read_attributes(instance.env)
    instance.reset(FIRST_SEED)
    start = read_attributes(instance.env)
    trials.play(FIRST_SEED, trials.actions(FIRST_SEED, HIDDEN_STEPS))
    end = read_attributes(instance.env)
    drawn = [name for name in find_unequal(start, others) if np.array_equal(start[name].numbers, end[name].numbers)]
    return {name: others[name] for name in drawn[:MOST_CHANGED] if name in end}


def _play_changed(instance: Instance, trials: Trials, name: str, other: Attribute) -> list[Frame] | None:
    actions = trials.actions(FIRST_SEED, HIDDEN_STEPS)
    try:
        return trials.play(FIRST_SEED, actions, lambda: read_attributes(instance.env)[name].assign(other.value))
    except OutOfTime:
        raise
    except (EnvironmentRaised, AttributeError, TypeError, ValueError, KeyError, NotJudged):
        return None


def _hides(plain: Sequence[Frame], changed: Sequence[Frame]) -> bool:
    steps = min(len(plain), len(changed)) - 2  # the last step may reach the goal, the reset has no reward
    differences = find_differences(plain[: steps + 1], changed[: steps + 1])
    only_reward = all(columns.tolist() == [REWARD] for columns in differences.values())
    return steps >= FEWEST_COMPARED and only_reward and len(differences) > steps // 2


def _is_shown(instance: Instance, name: str, shape: tuple[int, ...]) -> bool:
    rows, values = [], []
    for number in range(REGRESSED_RESETS):
        start = EpisodePlayer(instance, FIRST_SEED + number, max_steps=0).reset()
        attribute = read_attributes(instance.env).get(name)
        if attribute is not None and attribute.numbers.shape == shape:  # a reset may draw how many there are
            rows.append(flatten(start.observation).astype(np.float64))
            values.append(attribute.numbers)
    return explains(np.nan_to_num(np.stack(rows)), np.stack(values))


def explains(observed: NDArray[np.float64], wanted: NDArray[np.float64]) -> bool:
    """Say whether `wanted`, shape (n, k), is a linear function of `observed`, shape (n, m), in most of its variance."""
    observed = observed[:, observed.std(axis=0) > 0]
    wanted = wanted - wanted.mean(axis=0)
    if observed.shape[1] > len(observed) // 2:  # too many to fit: one that follows it closely is enough
        with np.errstate(invalid="ignore", divide="ignore"):
            related = np.corrcoef(observed.T, wanted.T)[: observed.shape[1], observed.shape[1] :]
        return bool((np.nan_to_num(np.abs(related)).max(axis=0) > np.sqrt(SHOWN)).all())
    design = np.column_stack([observed, np.ones(len(observed))])
    rest = wanted - design @ np.linalg.lstsq(design, wanted, rcond=None)[0]
    return bool((rest**2).sum() <= (1 - SHOWN) * (wanted**2).sum())


def _hidden(instance: Instance, name: str, plain: Sequence[Frame], changed: Sequence[Frame]) -> RuleFinding:
    step, value, expected = _find_largest(plain, changed)
    fault = f"reset draws {name}, the reward uses it, and the observation does not show it"
    proof = "with the value of another seed the same episode has the same observations"
    message = f"{fault}: {proof}, and at step {step} the reward {value:.4g} instead of {expected:.4g}"
    evidence = {"element": name, "seed": FIRST_SEED, "step": step, "value": value, "expected": expected}
    return RuleFinding(RULE, message, evidence, where=find_assignment(instance.env, name))


def _count_from_start(instance: Instance, name: str, plain: Sequence[Frame], changed: Sequence[Frame]) -> RuleFinding:
    step, value, expected = _find_largest(plain, changed)
    fault = f"reset sets {name}, no step sets it again, and the reward of each step uses it"
    proof = f"with the value of another seed step {step} pays {value:.4g} instead of {expected:.4g}"
    evidence = {"element": name, "seed": FIRST_SEED, "step": step, "value": value, "expected": expected}
    return RuleFinding(FROM_START, f"{fault}: {proof}", evidence, where=find_assignment(instance.env, name))


def _find_largest(plain: Sequence[Frame], changed: Sequence[Frame]) -> tuple[int, float, float]:
    """Return the step whose reward differs most, and this reward and the unchanged one."""
    step = int(np.argmax([abs(a[REWARD] - b[REWARD]) for a, b in zip(plain, changed, strict=False)]))
    return step, float(changed[step][REWARD]), float(plain[step][REWARD])
