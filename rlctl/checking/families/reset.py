"""RL114, RL306 and RL308 to RL311: what reset draws, seeds and hides, and what an ended episode leaves."""

import random
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.action_trials import REWARD, Frame, Trials, find_differences
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import INSTANCES, PROBE, experiment, judges_records
from rlctl.checking.families.determinism import COMPARED_STEPS, LATE, compare, find_difference, report
from rlctl.checking.families.rewards import has_succeeded
from rlctl.checking.instance import Context, EnvironmentRaised, Instance
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Records
from rlctl.checking.rule import NotApplicable, NotJudged, OutOfTime, RuleFinding
from rlctl.checking.values import Attribute, find_assignment, find_unequal, flatten, read_attributes, read_generators

HIDDEN_STEPS, FEWEST_COMPARED = 20, 5  # How many steps are compared with an attribute changed
MOST_CHANGED = 40  # So many attributes are changed
MOST_OBSERVED = 1_000  # Larger observations are images or scans, in which a goal may be drawn
REGRESSED_RESETS = 60  # Resets over which an attribute is predicted from the observation
SHOWN = 0.9  # part of an attribute's variance that the observation has to explain
MOST_SECOND_STEPS = 1_000  # most time limits are shorter
FAINT = 0.01  # smaller late differences are a residue, no counter or flag


@experiment("hidden state", INSTANCES, 70, "RL114", share=1.5)
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
            if frames is not None and _hides(plain, frames) and not _is_shown(instance, name):
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


def _is_shown(instance: Instance, name: str) -> bool:
    rows, values = [], []
    for number in range(REGRESSED_RESETS):
        start = EpisodePlayer(instance, FIRST_SEED + number, max_steps=0).reset()
        rows.append(flatten(start.observation).astype(np.float64))
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


def _hidden(instance: Instance, name: str, plain: Sequence[Frame], changed: Sequence[Frame]) -> RuleFinding:
    step = int(np.argmax([abs(a[REWARD] - b[REWARD]) for a, b in zip(plain, changed, strict=False)]))
    value, expected = float(changed[step][REWARD]), float(plain[step][REWARD])
    fault = f"reset draws {name}, the reward uses it, and the observation does not show it"
    proof = "with the value of another seed the same episode has the same observations"
    message = f"{fault}: {proof}, and at step {step} the reward {value:.4g} instead of {expected:.4g}"
    evidence = {"element": name, "seed": FIRST_SEED, "step": step, "value": value, "expected": expected}
    return RuleFinding("RL114", message, evidence, where=find_assignment(instance.env, name))


def play_after_ends(context: Context, success: Sequence[Any] | None) -> Iterator[ChildMessage]:
    """Record one episode on a new instance: alone, repeated, and after episodes that ended in every way there is;
    `success` are the actions that succeeded in the search, with the first seed."""
    ended: set[str] = set()
    instance = context.build()  # not closed: closing may break the kept instance (RL402), which later experiments use

    def record(role: str, seed: int, most: int, sequence: Sequence[Any] | None = None) -> Recording:
        recording = Recording(role, EpisodePlayer(instance, seed, max_steps=most, sequence=sequence))
        recording.run()
        return recording

    def repeat(role: str) -> Iterator[ChildMessage]:
        yield from record(role, FIRST_SEED, COMPARED_STEPS).run()

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


@judges_records("RL310", "search")
def _compare_after_ends(records: Records) -> Iterator[RuleFinding]:
    first, again = records.require_role("before ends"), records.require_role("before ends again")
    if not records.require_built().accepts_seed or find_difference(records, first, again) is not None:
        raise NotJudged("an episode already depends on the previous one (RL301 to RL303)")
    for role in ("after success", "after termination", "after truncation"):
        for episode in records.role(role):
            difference = find_difference(records, again, episode)
            if difference is not None and "raised" not in (again.ended, episode.ended):
                is_mild = difference.step > LATE and difference.size < FAINT
                ending = "that succeeded" if role == "after success" else f"that ended in {role[6:]}"
                what = f"played again after an episode {ending}"
                yield report("RL310", records, difference, what, mild=is_mild)
                return


WATCHED_STEPS = 300  # For how many steps the process's random generators are compared
UNSEEDED_RESETS, UNSEEDED_STEPS = 2, 20  # Of two discrete starts one may be the same by chance
FEWEST_SEEDS = 4


@judges_records("RL306", "comparisons", "episodes", of_absence=True)
def _compare_seeds(records: Records) -> Iterator[RuleFinding]:
    if compare(records, "alone", "seeds") is not None:
        return
    starts = [episode for episode in records.require_alone() if 0 in episode.observations]
    if (seeds := len({start.seed for start in starts})) < FEWEST_SEEDS:
        raise NotJudged(f"fewer than {FEWEST_SEEDS} seeds were tried")
    for index, _ in enumerate(records.require_built().leaves):
        values = [start.observations[index].values[0] for start in starts if index in start.observations]
        if any(not np.array_equal(values[0], other) for other in values[1:]):
            return
    steps = records.require_role("alone").steps
    message = f"{seeds} seeds give one start, and with the same actions one trajectory of {steps} steps"
    yield RuleFinding("RL306", message, {"seeds": seeds, "value": 1, "expected": seeds})


@experiment("unseeded", INSTANCES, 50, "RL308", share=0.5)
def compare_unseeded(context: Context) -> Iterator[ChildMessage]:
    """Play in two new instances after the same resets: first all with a seed, then the last ones without."""
    with context.fresh() as first, context.fresh() as second:
        if not first.accepts_seed:
            raise NotJudged("reset takes no seed (RL202)")
        if _differing(*(_play(instance, seed=FIRST_SEED) for instance in (first, second))):
            raise NotJudged("equal seeds and actions give unequal episodes (RL3)")
        values = _differing(*(_play(instance) for instance in (first, second)))
        agree = read_generators(first.env) == read_generators(second.env)
        if values and agree and _differing(*(_play(instance, seed=FIRST_SEED) for instance in (first, second))):
            raise NotJudged("an episode already depends on the previous one (RL301 to RL303)")
    if values:
        numbers = f"an observation contains {values[0]:.6g}, in another instance {values[1]:.6g}"
        evidence = {"seed": FIRST_SEED, "value": values[1], "expected": values[0]}
        yield RuleFinding("RL308", f"reset first with a seed, then without: {numbers}", evidence)


def _play(instance: Instance, **seed: int) -> NDArray[np.float64]:
    episode = EpisodePlayer(instance, FIRST_SEED, max_steps=UNSEEDED_STEPS)
    episode.reset()
    starts = [instance.call("reset", instance.env.reset, **seed) for _ in range(UNSEEDED_RESETS)]
    observations = [start[0] if isinstance(start, tuple) else start for start in starts]
    while not episode.ended:
        observations.append(episode.step().observation)
    numbers = np.concatenate([flatten(observation) for observation in observations])
    return np.nan_to_num(numbers.astype(np.float64))


def _differing(one: NDArray[np.float64], two: NDArray[np.float64]) -> list[float]:
    rows = min(len(one), len(two))
    unequal = np.flatnonzero(one[:rows] != two[:rows])
    return [float(numbers[unequal[0]]) for numbers in (one, two)] if unequal.size else []


@experiment("global random", PROBE, 30, "RL309", share=0.5)
def compare_generators(context: Context) -> Iterator[ChildMessage]:
    """Play the beginning of an episode, and say which generators of the whole process it moves, and where first."""
    moved: set[str] = set()
    episode = EpisodePlayer(context.instance, FIRST_SEED, max_steps=WATCHED_STEPS)
    before = _read_generators()
    for moment in episode:
        for generator, state in _read_generators().items():
            if state != before.get(generator, state) and generator not in moved:
                moved.add(generator)
                call, at = ("step", f" at step {moment.step}") if moment.step else ("reset", "")
                evidence = {"generator": generator, "call": call, "step": moment.step}
                yield RuleFinding("RL309", f"{call} moves the global generator {generator}{at}", evidence)
        before = _read_generators()


def _read_generators() -> dict[str, Any]:
    kind, keys, position, *rest = np.random.get_state()  # noqa: NPY002 (this one is what is compared)
    states = {"numpy.random": (kind, np.asarray(keys).tobytes(), position, *rest), "random": random.getstate()}
    if "torch" in sys.modules:
        states["torch"] = sys.modules["torch"].random.get_rng_state().numpy().tobytes()
    return states
