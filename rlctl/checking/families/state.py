"""RL114, RL310 and RL311: what reset draws and hides, what an ended episode leaves, and generators without a seed."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.action_trials import REWARD, Frame, Trials, find_differences
from rlctl.checking.attributes import Attribute, find_assignment, find_unequal, read_attributes
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.failures import EnvironmentRaised
from rlctl.checking.families.determinism import COMPARED_STEPS, LATE, find_difference, report
from rlctl.checking.families.rewards import has_succeeded
from rlctl.checking.instance import Context, Instance
from rlctl.checking.leaves import flatten_numbers
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Records
from rlctl.checking.rules import NotApplicable, NotJudged, OutOfTime, RuleFinding, check, experiment

HIDDEN_STEPS = 20  # How many steps are compared with an attribute changed
FEWEST_COMPARED = 5
MOST_CHANGED = 40  # So many attributes are changed
MOST_OBSERVED = 1_000  # Larger observations are images or scans, in which a goal may be drawn
REGRESSED_RESETS = 60  # Resets over which an attribute is predicted from the observation
SHOWN = 0.9  # part of an attribute's variance that the observation has to explain
MOST_SECOND_STEPS = 1_000  # most time limits are shorter
FAINT = 0.01  # smaller late differences are a residue, no counter or flag
AFTER_ENDS = ("after success", "after termination", "after truncation")


@experiment("hidden state", "RL114", share=1.5)
def change_attributes(context: Context) -> Iterator[ChildMessage]:
    """Play one episode again and again, each time with one attribute as reset drew it for another seed."""
    with context.fresh() as instance:
        trials = Trials(context, instance)
        trials.require_repeatable()
        plain = trials.plain(FIRST_SEED, HIDDEN_STEPS)  # known by now
        if plain[0].size > MOST_OBSERVED:
            raise NotApplicable(f"the observation has more than {MOST_OBSERVED} numbers")
        for name, other in _find_drawn(instance, trials).items():
            frames = _play_changed(instance, trials, name, other)
            if frames is not None and _hides(plain, frames) and not _is_shown(instance, name):
                yield _hidden(instance, name, other, plain, frames)
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

    def change() -> None:
        read_attributes(instance.env)[name].assign(other.value)

    try:
        return trials.play(FIRST_SEED, trials.actions(FIRST_SEED, HIDDEN_STEPS), after_reset=change)
    except OutOfTime:
        raise
    except (EnvironmentRaised, AttributeError, TypeError, ValueError, KeyError, NotJudged):
        return None


def _hides(plain: Sequence[Frame], changed: Sequence[Frame]) -> bool:
    steps = min(len(plain), len(changed)) - 2  # the last step may reach the goal, the reset has no reward
    differences = find_differences(plain[: steps + 1], changed[: steps + 1])
    only_reward = all(columns.tolist() == [REWARD] for columns in differences.values())
    return steps >= FEWEST_COMPARED and only_reward and len(differences) > steps // 2


def _is_shown(instance: Instance, name: str) -> bool:
    rows, values = [], []
    for number in range(REGRESSED_RESETS):
        returned = instance.reset(FIRST_SEED + number)
        observation = returned[0] if isinstance(returned, tuple) else returned
        rows.append(flatten_numbers(observation).astype(np.float64))
        values.append(read_attributes(instance.env)[name].numbers)
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


def _hidden(
    instance: Instance, name: str, other: Attribute, plain: Sequence[Frame], changed: Sequence[Frame]
) -> RuleFinding:
    step = int(np.argmax([abs(a[REWARD] - b[REWARD]) for a, b in zip(plain, changed, strict=False)]))
    message = (
        f"reset draws {name}, the reward uses it, and the observation does not show it: with the value of another seed "
        f"the same episode has the same observations, and at step {step} the reward {changed[step][REWARD]:.4g} "
        f"instead of {plain[step][REWARD]:.4g}"
    )
    evidence: dict[str, Any] = {"element": name, "seed": FIRST_SEED, "step": step}
    evidence |= {"value": float(changed[step][REWARD]), "expected": float(plain[step][REWARD])}
    return RuleFinding("RL114", message, evidence, where=find_assignment(instance.env, name))


def play_after_ends(context: Context, success: Sequence[Any] | None) -> Iterator[ChildMessage]:
    """Record one episode on a new instance: alone, repeated, and after episodes that ended in every way there is.

    `success` are the actions that succeeded in the search, with the first seed.
    """
    ended: set[str] = set()
    instance = context.build()  # not closed: closing may break the kept instance (RL402), which later experiments use

    def record(role: str, seed: int, most: int, sequence: Sequence[Any] | None = None) -> Recording:
        recording = Recording(role, EpisodePlayer(instance, seed, max_steps=most, sequence=sequence), context.budget)
        recording.run()
        return recording

    def repeat(role: str) -> Iterator[ChildMessage]:
        yield from record(role, FIRST_SEED, COMPARED_STEPS).messages()

    yield from repeat("before ends")
    yield from repeat("before ends again")
    if success is not None and has_succeeded(record("", FIRST_SEED, len(success), success).trajectory):
        yield from repeat("after success")
    for seed in (SECOND_SEED, SECOND_SEED + 1):
        how = record("", seed, MOST_SECOND_STEPS).trajectory.ended
        role = {"terminated": "after termination", "truncated": "after truncation"}.get(how)
        if role and role not in ended and not context.budget.why_spent():
            ended.add(role)
            yield from repeat(role)


@check("RL310", "search")
def _compare_after_ends(records: Records) -> Iterator[RuleFinding]:
    built, first = records.require_built(), records.require_role("before ends")
    again = records.require_role("before ends again")
    if not built.accepts_seed or find_difference(built, first, again) is not None:
        raise NotJudged("an episode depends already on the one before it (RL301 to RL303)")
    for role in AFTER_ENDS:
        for episode in records.role(role):
            difference = find_difference(built, again, episode)
            if difference is not None and "raised" not in (again.ended, episode.ended):
                is_mild = difference.step > LATE and difference.size < FAINT
                what = f"played again {_name_end(role)}"
                yield report("RL310", records, again, difference, what, is_mild=is_mild)
                return


def _name_end(role: str) -> str:
    return {"after success": "after an episode that succeeded"}.get(role, f"after an episode that ended in {role[6:]}")
