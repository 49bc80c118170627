"""RL622: being far from the goal pays."""

import ast
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.drawn_goals import Numbers, Source
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.goals import judges_goals
from rlctl.checking.goal_episodes import GoalEpisode, GoalTrials
from rlctl.checking.leaving import Leaving, find_leaving
from rlctl.checking.paid_distances import RiseReader
from rlctl.checking.paid_goals import GoalReader
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.reward_peaks import Peak, find_peaks
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names

RULE = Rule(
    "RL622",
    "being far from the goal pays",
    Severity.WARNING,
    meaning="""
        The further away the goal is, the larger is the reward, to both sides; or every failure pays more than
        success, which goes on; or a goal that goes away pays more than one that comes nearer; or the reward rises
        through the goal and beyond, as a sum of differences with their signs does; or it rises as the robot goes
        away from the object that it has to bring to the goal; or it is highest with the goal somewhere else than where
        it is a success. The check played the same steps again, and put the goal, or the command, where is_success is
        true, and at several distances from there. The source is read, too: a function that falls with a distance is
        subtracted, a distance to a goal is added, or what it has grown by in the step; and where the source computes a
        distance to a goal or to an object, it is set to several values, and the same step pays more for larger ones.
        So the policy learns to keep away from the goal. Most often a sign is wrong, or an error is paid instead of a
        function that falls with it, or differences are added instead of their sizes.
    """,
    fix="""
        Make the reward largest where the task is done: subtract the distance or the error, pay
        exp(-error / scale), or pay progress as previous - distance.
    """,
)

FIRST_STEPS = 10  # with the action that the episode holds, so that the robot is somewhere else in each
LATER_STEPS = 2  # with the goal moved: the first may pay the way to it as progress
EPISODES, MOST_EPISODES = 3, 10  # that are needed, and that are tried
TRACED_STEPS = 60  # in which large actions may move it
FEWEST_MOVED = 0.02  # part of the goals' range: how far apart the robot is in these episodes
RADII = (0.35, 0.7, 1.0)  # parts of the goals' range
WAY_RADIUS, WAY = 0.7, 0.2
"""Parts of the goals' range, at which a goal is that comes nearer or goes away in a step, and of this distance."""
MOST_TURN = 0.45  # part of a turn: an angle that is further away is nearer on the other side
ALIKE = 0.05  # part of the largest rise of a reward, by which those of other episodes may differ
LEAST = 1e-6  # differences of rewards that count, of their size


@dataclasses.dataclass(frozen=True)
class _Outcome:
    """What a goal gave that is as far from the robot as `offset`."""

    reward: float
    succeeds: bool
    has_ended: bool  # and how: by this step or one before
    place: Numbers  # of the robot


_MeasureAxis = Callable[[GoalTrials, Source, int, int, _Outcome], Sequence[float]]
"""Returns rewards that show something wrong along an axis in an episode, or nothing."""
_Describe = Callable[[GoalTrials, Sequence[int], Sequence[float]], RuleFinding]
"""Describes what is wrong along some axes, by these rewards."""


@judges_goals(RULE)
def _compare_goals(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Put the goal where the robot is, and to either side."""
    source, reports_success = _find_source(trials)
    if trials.drawn.place.later:
        source = None  # each of several goals is reached by another step
    if not reports_success:
        yield Skipped(RULE.id, "no success is reported", applies=False)
        return
    is_held = source is None  # whether a success takes longer than the steps that are compared
    at_goal = trials.at_goal.source
    leaving = None if at_goal is None else find_leaving(trials, at_goal)
    if leaving is not None:
        yield _describe_leaving(trials, leaving)
        return
    source = at_goal if source is None else source
    if source is None:
        yield Skipped(RULE.id, "no goal next to the robot was a success")
        return
    insides = _find_insides(trials, source, is_held)
    if len(insides) < EPISODES:
        yield Skipped(RULE.id, _explain_few(len(insides)))
        return
    moved = np.ptp(np.array([inside.place for inside in insides.values()]), axis=0) > FEWEST_MOVED * trials.range
    if not moved.any():
        moved = _find_moved(trials, list(insides))
    looks: list[tuple[_MeasureAxis, _Describe]] = [
        (_measure_sides, _describe_distance),
        (_measure_ways, _describe_way),
    ]
    for measure, describe in looks:
        axes, shown = _find_axes(trials, source, insides, measure)
        axes = [axis for axis in axes if moved[axis]]
        if axes:
            yield describe(trials, axes, shown)
            return
    axes, shown = _find_signed(trials, source, insides)
    axes = [axis for axis in axes if moved[axis]]
    if axes:
        yield _describe_signed(trials, axes, shown)
        return
    if len(source) > 2 or not source[1]:
        return  # what has to be at the goal is not observed relative to it: RL626
    room = [_find_room(trials, axis) if moved[axis] else 0.0 for axis in range(len(moved))]
    if peaks := find_peaks(trials, source, room):
        yield _describe_peak(trials, peaks)


def _find_moved(trials: GoalTrials, numbers: Sequence[int]) -> NDArray[np.bool_]:
    """Say along which axes that moves in longer episodes which is at the goal in these ones, where it has not moved
    yet, as a door that nobody has touched. Shape (size,)."""
    moved = np.zeros(trials.range.shape, np.bool_)
    for source in trials.drawn.copies:
        if all(trials.is_success_after(FIRST_SEED + number, source, FIRST_STEPS) for number in numbers):
            moved |= np.ptp(np.vstack(list(_trace(trials, source))), axis=0) > FEWEST_MOVED * trials.range
    return moved


def _trace(trials: GoalTrials, source: Source) -> Iterator[Numbers]:
    """Yield the places by a source in some episodes of large actions, while their goals stay."""
    for number in range(EPISODES):
        episode = GoalEpisode(trials, FIRST_SEED + number, "extreme")
        for _ in episode.follow(itertools.repeat(None, TRACED_STEPS)):
            if episode.has_moved_on:
                break
            yield episode.read(source)


def _describe_peak(trials: GoalTrials, peaks: Sequence[Peak]) -> RuleFinding:
    name, places = trials.drawn.name, list_names([f"{peak.offset:.3g}" for peak in peaks])
    message = f"the reward is highest with {trials.drawn.name_axis(peaks[0].axis)} {places} away from where {name} is a"
    message += f" success, in {len(peaks)} episodes: {peaks[0].reward:.4g} there, and {peaks[0].nearest:.4g} next to"
    evidence = {"element": name, "value": peaks[0].reward, "expected": f"below {peaks[0].nearest:.6g}"}
    return RuleFinding(RULE, f"{message} the success", evidence)


def _describe_leaving(trials: GoalTrials, leaving: Leaving) -> RuleFinding:
    verbs = ("go away", "are") if " and " in leaving.point else ("goes away", "is")
    what = verbs[0] if leaving.is_change else verbs[1]
    message = f"the reward rises by {leaving.slope:.3g} for each unit that {leaving.point} {what} from {leaving.item},"
    message += f" which has to be brought to {trials.drawn.name} ({leaving.steps} steps in which it rests)"
    return RuleFinding(RULE, message, {"element": trials.drawn.name, "value": leaving.slope, "expected": "below 0"})


def _find_signed(
    trials: GoalTrials, source: Source, insides: Mapping[int, _Outcome]
) -> tuple[list[int], Sequence[float]]:
    """Return the axes along which the rewards rise from one side of the goal to the other, by the same in all episodes,
    and those of one: from the lowest to the highest, at distances of `RADII` to both sides. Shape (2 * len(RADII),)."""
    found: list[int] = []
    shown: Sequence[float] = ()
    for axis in range(trials.goals.shape[1]):
        profiles: list[Numbers] = []
        for number in insides:
            profile = _measure_profile(trials, source, number, axis)
            if profile is None or (profiles and not _is_alike(profiles[0], profile)):
                break
            profiles.append(profile)
        if len(profiles) == len(insides):
            found.append(axis)
            shown = profiles[0].tolist()
    return found, shown


def _measure_profile(trials: GoalTrials, source: Source, number: int, axis: int) -> Numbers | None:
    """Return the rewards with the goal from one side of the robot to the other, if they rise: beyond it at each step,
    and before it they may be limited. None if they do not, or if any is a success or the end. The sign of the side that
    pays is the last number."""
    outcomes = []
    for radius in (*(-one for one in RADII[::-1]), *RADII):
        offsets = np.zeros((LATER_STEPS, trials.goals.shape[1]))
        offsets[:, axis] = radius * _find_room(trials, axis)
        outcome = _measure(trials, source, number, offsets)
        if outcome is None or outcome.succeeds or outcome.has_ended:
            return None
        outcomes.append(outcome.reward)
    rewards = np.array(outcomes)
    least = LEAST * max(1.0, float(np.abs(rewards).max()))
    for sign in (1, -1):
        steps = np.diff(rewards[::sign])
        if steps.min() > -ALIKE * steps.max() and (steps[len(RADII) - 1 :] > least).all():
            return np.array([*rewards[::sign], sign])
    return None


def _is_alike(one: Numbers, two: Numbers) -> bool:
    """Say whether rewards rise by the same beyond the goal, and to the same side."""
    beyond = slice(len(RADII), 2 * len(RADII))
    rises = np.diff(one[beyond]), np.diff(two[beyond])
    return bool(one[-1] == two[-1] and np.abs(rises[0] - rises[1]).max() < ALIKE * rises[0].max())


def _describe_signed(trials: GoalTrials, axes: Sequence[int], shown: Sequence[float]) -> RuleFinding:
    *rewards, sign = shown
    away = RADII[-1] * _find_room(trials, axes[0])
    near = RADII[0] * _find_room(trials, axes[0])
    name = trials.drawn.name_axis(axes[0])
    side = "below" if sign < 0 else "above"
    message = f"the reward rises through the goal: {rewards[0]:.4g}, {rewards[len(RADII)]:.4g} and {rewards[-1]:.4g}"
    message += (
        f" with {name} {away:.3g} on one side of the place of a success, {near:.3g} {side} it and {away:.3g} {side} it"
    )
    message += f" ({_name_axes(trials, axes)}): a distance has no sign"
    evidence = {"element": trials.drawn.name, "value": rewards[-1], "expected": f"below {rewards[len(RADII)]:.6g}"}
    return RuleFinding(RULE, message, evidence)


def _explain_few(count: int) -> str:
    """Return why `count` episodes with a success are too few."""
    return (
        f"with the goal put where the robot is, {count} of {MOST_EPISODES} episodes had a success; "
        f"the comparison needs {EPISODES}"
    )


def _find_insides(trials: GoalTrials, source: Source, is_held: bool) -> dict[int, _Outcome]:
    """Return what a goal gives that is where the robot is, by episode; of those in which it is a success, at once or
    later."""
    insides: dict[int, _Outcome] = {}
    for number in range(MOST_EPISODES):
        inside = _measure(trials, source, number, np.zeros((LATER_STEPS, trials.goals.shape[1])))
        if inside is not None and (inside.succeeds or is_held):
            insides[number] = inside
        if len(insides) == EPISODES:
            break
    return insides


def _find_axes(
    trials: GoalTrials, source: Source, insides: Mapping[int, _Outcome], measure: _MeasureAxis
) -> tuple[list[int], Sequence[float]]:
    """Return the axes along which something wrong is measured in all episodes, and rewards that show it."""
    axes = list(range(trials.goals.shape[1]))
    shown: Sequence[float] = ()
    for number, inside in insides.items():
        wrong = {axis: measure(trials, source, number, axis, inside) for axis in axes}
        axes = [axis for axis in axes if wrong[axis]]
        if not axes:
            return [], ()
        shown = wrong[axes[0]]
    return axes, shown


def _describe_distance(trials: GoalTrials, axes: Sequence[int], shown: Sequence[float]) -> RuleFinding:
    near, *_, far = shown
    lengths = " and ".join(f"{radius * _find_room(trials, axes[0]):.3g}" for radius in (RADII[0], RADII[-1]))
    rises = f"the reward rises with the distance to the goal ({_name_axes(trials, axes)})"
    if far <= near:
        rises = f"the reward is larger at any distance to the goal ({_name_axes(trials, axes)}) than at the goal"
    message = f"{rises}: {near:.4g} and {far:.4g} at {lengths}"
    evidence = {"element": trials.drawn.name, "value": far, "expected": f"below {near:.6g}"}
    return RuleFinding(RULE, message, evidence)


def _describe_way(trials: GoalTrials, axes: Sequence[int], shown: Sequence[float]) -> RuleFinding:
    near, far = shown
    way = f"{WAY * WAY_RADIUS * _find_room(trials, axes[0]):.3g}"
    comes = f"the reward is {near:.4g} where the goal ({_name_axes(trials, axes)}) comes {way} nearer in a step"
    message = f"{comes}, and {far:.4g} where it goes as far away"
    evidence = {"element": trials.drawn.name, "value": far, "expected": f"below {near:.6g}"}
    return RuleFinding(RULE, message, evidence)


def _name_axes(trials: GoalTrials, axes: Sequence[int]) -> str:
    return list_names([trials.drawn.name_axis(axis) for axis in axes])


def _find_source(trials: GoalTrials) -> tuple[Source | None, bool]:
    """Return the part of the observation with the place that a goal has to have for a success; and whether success is
    reported at all."""
    episode, reports_success = _begin(trials, 0), False
    for source in trials.list_sources(episode):
        if episode.has_ended:
            episode = _begin(trials, 0)
        for step in episode.play([episode.read(source)]):
            reports_success |= step.succeeds is not None
            if step.succeeds:
                return source, True
    return None, reports_success


def _begin(trials: GoalTrials, number: int) -> GoalEpisode:
    return GoalEpisode(trials, FIRST_SEED + number, "repeated", FIRST_STEPS)


def _measure(trials: GoalTrials, source: Source, number: int, offsets: Numbers) -> _Outcome | None:
    """Return what a goal gives that is so far from the robot in the later steps, which moves as in the last one; None
    if the episode ended before, or had a success already. Shape of the offsets: (LATER_STEPS, size)."""
    episode = GoalEpisode(trials, FIRST_SEED + number, "repeated", FIRST_STEPS - 1)
    before = episode.read(source)
    episode.play([None])
    outcome = None
    if episode.has_succeeded:
        return None
    for step, place in episode.lead(source, before, offsets):
        outcome = _Outcome(step.reward, bool(step.succeeds), episode.has_ended, place)
    return outcome


def _measure_sides(trials: GoalTrials, source: Source, number: int, axis: int, inside: _Outcome) -> Sequence[float]:
    """Return the rewards with the goal at larger and larger distances to one side of the robot, if they rise, and so do
    those to the other side; or if all are larger than that of a success. Otherwise nothing."""
    shown: list[float] = []
    for sign in (1.0, -1.0):
        outside = []
        for radius in RADII:
            offsets = np.zeros((LATER_STEPS, trials.goals.shape[1]))
            offsets[:, axis] = sign * radius * _find_room(trials, axis)
            outcome = _measure(trials, source, number, offsets)
            if outcome is None or outcome.succeeds or outcome.has_ended:
                return ()
            outside.append(outcome.reward)
            if not _rises(outside) and not _exceeds(outside, inside):
                return ()
        shown = outside
    return shown


def _measure_ways(trials: GoalTrials, source: Source, number: int, axis: int, _: _Outcome) -> Sequence[float]:
    """Return the rewards with a goal to one side of the robot that comes nearer in the last step, and with one that
    goes as far away, if the second is larger, and so it is to the other side. Otherwise nothing."""
    shown: list[float] = []
    for sign in (1.0, -1.0):
        rewards = []
        for change in (-WAY, WAY):
            offsets = np.zeros((LATER_STEPS, trials.goals.shape[1]))
            offsets[:, axis] = sign * WAY_RADIUS * _find_room(trials, axis)
            offsets[-1] *= 1 + change
            outcome = _measure(trials, source, number, offsets)
            if outcome is None or outcome.succeeds or outcome.has_ended:
                return ()
            rewards.append(outcome.reward)
        if not _rises(rewards):
            return ()
        shown = rewards
    return shown


def _find_room(trials: GoalTrials, axis: int) -> float:
    """Return how far from the robot a goal may be put along an axis."""
    return float(min(trials.range[axis], MOST_TURN * trials.turns[axis]))


def _rises(rewards: Sequence[float]) -> bool:
    least = LEAST * max(1.0, *map(abs, rewards))
    return all(far > near + least for near, far in itertools.pairwise(rewards))


def _exceeds(rewards: Sequence[float], inside: _Outcome) -> bool:
    """Say whether failures pay more than a success that does not end the episode."""
    least = LEAST * max(1.0, *map(abs, rewards))
    return not inside.has_ended and min(rewards) > inside.reward + least


@judges_expressions(RULE, place=1, decides=False)  # after others: it plays much
def _read_signs(notes: NotedEpisodes) -> Iterator[ChildMessage]:
    """Yield the first summand of the reward whose sign pays for a distance."""
    for paid in notes.share(GoalReader).find_wrong_signs():
        text, weight = ast.unparse(paid.place.node), paid.summand.weight
        message = f"{paid.how} in the source of the reward: {text} counts {weight:+.4g} times"
        yield RuleFinding(RULE, message, {"element": paid.summand.name}, where=notes.reward.locate(paid.place))
        return
    reader = RiseReader(notes)
    for distance, summand in reader.find_paid():
        message = f"the reward adds {ast.unparse(summand.place.node)}, which rises with the distance"
        message += f" {distance.expression.text}"
        where = notes.reward.locate(summand.place)
        yield RuleFinding(RULE, message, {"element": distance.expression.text}, where=where)
        return
    for rise in reader.find_rises():
        (close, near), (away, far) = rise.near, rise.far
        message = (
            f"the reward rises with the distance {rise.distance.expression.text}, by {ast.unparse(rise.place.node)}:"
        )
        message += f" the same steps pay {near:.4g} where it is {close:.3g}, and {far:.4g} where it is {away:.3g}"
        evidence = {"element": rise.distance.expression.text, "value": far, "expected": f"below {near:.6g}"}
        yield RuleFinding(RULE, message, evidence, where=notes.reward.locate(rise.place))
        return
