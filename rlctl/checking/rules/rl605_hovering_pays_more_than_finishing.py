"""RL605: hovering pays more than finishing."""

import ast
import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking import rewards
from rlctl.checking.drawn_goals import Numbers, Source
from rlctl.checking.episode import zero_action
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.goals import judges_goals
from rlctl.checking.experiments.search import ActionSearch, judges_searches
from rlctl.checking.goal_episodes import GoalEpisode, GoalStep, GoalTrials
from rlctl.checking.paid_goals import GoalReader
from rlctl.checking.paid_successes import SuccessReader
from rlctl.checking.records import FIRST_SEED, CheckedEpisode, ChildMessage, Fact, Records, Skipped
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.environments.success import SUCCESS

RULE = Rule(
    "RL605",
    "hovering pays more than finishing",
    Severity.WARNING,
    meaning="""
        The goal ends the episode, and with it a positive reward per step: stopping just before the goal and
        staying there earns more than finishing, so the policy learns to hover. rlctl repeated an episode that
        finished, and stopped shortly before its end; or every recorded success pays less than the steps would
        have paid that were left, by what episodes without a success earn. Or the check moved the goal: next to the
        robot, which rests or which the goal accompanies, each step pays, and a success ends that for less. The
        same is read in the source: what its terms pay at the goal, and what success adds, or replaces them by; and a
        step with success set to true pays less than without it, with the goal as near.
    """,
    fix="""
        Pay for finishing at least what staying near the goal would earn to the end of the episode, pay for
        progress instead of for being near, or do not end the episode at the goal.
    """,
)

FAR_ABOVE = 5.0  # times the spread of early rewards; a robot that falls at speed ends with a good reward
STOPS = (1, 2, 4, 8)  # steps before the end of a finished episode, to stop there
CLEARLY = 0.1  # How much more stopping has to earn than finishing
FEWEST, EARLY = 3, 0.5  # successes, and the part of the longest episode in which they are
FAR_MORE = 2.0  # times as much as success; it may be worth less to stay where others were
MOST_LOST = 0.5  # times as much as success, discounted, where the undiscounted sum is `FAR_MORE`
LATE = 10  # steps after the recorded ones are assumed to earn the mean of the last so many rewards


IN_SOURCE = "incomes in the source"
"""The fact with what each step pays next to the goal, what success pays, and whether time is paid."""
NEAR_GOAL = "near the goal"
"""The fact of an `Income`."""
FIRST_STEPS, RESTING_STEPS = 15, 12  # with the goal that reset drew, in which robots settle; and next to the robot
OFFSETS = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32)  # of the goals' range: how far the goal is from the robot
STILL = 0.25  # part of this distance that the robot may move
SHOWN = 3  # episodes that have to show it


@dataclasses.dataclass(frozen=True)
class Income:
    """What an episode earns that rests near its goal, and what it earns by a success."""

    seed: int
    per_step: float
    distance: float
    success: float


@judges_records(RULE, *rewards.WITH_SEARCH, "goals", "expressions")
def _compare_incomes(records: Records) -> Iterator[RuleFinding]:
    in_source = list(_compare_in_source(records))
    try:
        found = list(_compare_successes(records)) or list(_compare_with_moved_goal(records))
    except (NotApplicable, NotJudged):
        if not in_source:
            raise
        found = []
    yield from found or in_source


def _compare_with_moved_goal(records: Records) -> Iterator[RuleFinding]:
    """Compare what is earned at rest near a goal with what a success pays, which ends the episode."""
    incomes: list[Income] = records.facts.get(NEAR_GOAL, [])
    if not incomes:
        return
    longest = records.require_built().max_steps or max(one.steps for one in rewards.require_rewarded(records))
    least = min(incomes, key=lambda one: one.per_step)
    hovering = rewards.discounted_steps(least.per_step, longest - FIRST_STEPS)
    whole = least.per_step * (longest - FIRST_STEPS)
    paid = max(one.success for one in incomes)
    if not _is_worth_more(hovering, whole, paid):
        return
    staying = f"staying {least.distance:.3g} from the goal pays {least.per_step:.3g} in each step"
    message = f"success ends the episode and pays {paid:.4g}; {staying}, {whole:.4g} until step {longest}"
    message += f", or {hovering:.4g} with a discount of {rewards.DISCOUNT}"
    evidence = {"seed": least.seed, "value": hovering, "expected": f"below {paid:.6g}", "per_step": least.per_step}
    yield RuleFinding(RULE, message, evidence)


def _is_worth_more(hovering: float, whole: float, paid: float) -> bool:
    """Say whether staying is worth far more than a success, discounted, or also undiscounted."""
    # Long episodes may not be discounted so much, and evaluations are not discounted at all.
    is_more = hovering > FAR_MORE * max(paid, 0.0)
    return is_more or (whole > FAR_MORE * max(paid, 0.0) and hovering > MOST_LOST * paid)


@judges_goals(RULE, decides=False)
def _rest_near_goal(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Put the goal at the robot, and next to it."""
    source = trials.at_goal.source
    if source is None:
        return
    incomes = []
    for seed in range(FIRST_SEED, FIRST_SEED + SHOWN):
        income = _measure_income(trials, source, seed)
        if income is None or income.per_step <= 0:
            return
        incomes.append(income)
    yield Fact(NEAR_GOAL, incomes)


def _measure_income(trials: GoalTrials, source: Source, seed: int) -> Income | None:
    """Return what an episode earns near its goal and at it; None where the robot moves, the success does not end the
    episode, or the goal is not missed at any distance."""
    arriving = GoalEpisode(trials, seed, "zero", FIRST_STEPS + 1)
    if arriving.has_ended or arriving.has_succeeded:
        return None
    place = arriving.read(source)
    at_goal = GoalEpisode(trials, seed, "zero", FIRST_STEPS)
    success = at_goal.hold(place, source)
    if not success.succeeds or not at_goal.has_ended:
        return None
    for offset in OFFSETS:
        way = offset * trials.range
        resting = GoalEpisode(trials, seed, "zero", FIRST_STEPS)
        steps = resting.play([place + way] * RESTING_STEPS)
        if resting.has_succeeded:
            continue
        distance = float(np.linalg.norm(way))
        is_still = not resting.has_ended and np.linalg.norm(resting.read(source) - place) <= STILL * distance
        if not is_still:
            resting, steps = _accompany(trials, source, seed, way)
            if resting.has_succeeded:
                continue
            if resting.has_ended:
                return None
        # What is paid for a change of the distance is paid once, when the goal is moved.
        late = float(np.mean([step.reward for step in steps[len(steps) // 2 :]]))
        # A source that is constant is where a robot begins, and not where it is now.
        if not resting.hold(resting.read(source), source).succeeds:
            return None
        return Income(seed, late, distance, success.reward)
    return None


def _accompany(trials: GoalTrials, source: Source, seed: int, way: Numbers) -> tuple[GoalEpisode, list[GoalStep]]:
    """Play steps in which the goal stays as far from a robot that moves; return the episode, too."""
    episode = GoalEpisode(trials, seed, "zero", FIRST_STEPS)
    steps: list[GoalStep] = []
    while len(steps) < 2 * RESTING_STEPS and not episode.has_ended:
        steps.append(episode.step(episode.read(source) + way))
    return episode, steps


def _compare_successes(records: Records) -> Iterator[RuleFinding]:
    """Compare what recorded successes pay with what their episodes would have earned without them."""
    episodes = rewards.require_rewarded(records)
    longest = records.require_built().max_steps or max(one.steps for one in episodes)
    # A late success loses little. What is to be learned is an early one.
    early = [one for one in episodes if one.steps <= EARLY * longest]
    finished = [one for one in early if one.terminated[-1] and rewards.ends_in_success(one)]
    lasting = [one for one in episodes if one.steps >= longest and not rewards.has_succeeded(one)]
    if len(finished) < FEWEST or not lasting:
        return
    income = float(np.median([one.rewards[one.steps // 2 :].mean() for one in lasting]))
    if income <= 0:
        return
    least = min(finished, key=lambda one: _find_lost(one, income, longest) - FAR_MORE * one.rewards[-1])
    lost, paid = _find_lost(least, income, longest), float(least.rewards[-1])
    if lost <= FAR_MORE * max(paid, 0.0):
        return
    message = (
        f"success ends an income, in each of {len(finished)} early successes: at step {least.steps} it pays {paid:.4g},"
    )
    message += f" and the steps until {longest} are worth {lost:.4g} (discount {rewards.DISCOUNT})"
    message += f" at {income:.3g} per step, which episodes without a success earn"
    yield RuleFinding(RULE, message, least.at(least.steps, value=lost, expected=f"below {paid:.6g}", per_step=income))


def _find_lost(finished: CheckedEpisode, income: float, longest: int) -> float:
    """Return what the steps would have earned from the success on until the time limit, discounted to it."""
    return rewards.discounted_steps(income, 1 + longest - finished.steps)


@judges_searches(RULE)
def _stop_early(search: ActionSearch) -> Iterator[ChildMessage]:
    """Repeat an episode that finished, and stop it shortly before its end."""
    is_reported = rewards.reports_success([attempt.played for attempt in search.attempts])
    finished = [attempt for attempt in search.attempts if _finishes(attempt.played, is_reported)]
    if not finished:
        yield Skipped(RULE.id, "no searched episode ended in success", applies=False)
        return
    best = max(finished, key=lambda attempt: attempt.played.rewards[-1])
    one, nothing = best.played, zero_action(search.space)
    stops: list[Stop] = []
    for before in STOPS:
        at = max(0, one.steps - before)
        if search.goes_on():
            yield from search.play([*best.sequence[:at], *[nothing] * (search.length - at)])
            two = search.attempts[-1].played
            is_same = np.array_equal(one.rewards[:at], two.rewards[:at]) and two.ended != "raised"
            if is_same and two.steps > one.steps and not _finishes(two, is_reported):
                longest = search.instance.max_steps or max(attempt.played.steps for attempt in search.attempts)
                stops.append(compare_returns(one, two, at, longest))
    if not is_reported:
        stops = [stop for stop in stops if stop.finishing > 0]  # an end that costs more than it pays is no goal
    yield from _judge_stops(one, stops)


def _finishes(episode: CheckedEpisode, success_is_reported: bool) -> bool:
    if episode.ended not in ("terminated", "both"):
        return False
    if success_is_reported:
        # Where an earlier success has not ended it, something else does.
        return rewards.ends_in_success(episode) and int((episode.infos[SUCCESS].values > 0).sum()) == 1
    begin = episode.rewards[: episode.steps // 2]
    last = episode.rewards[-1]
    return len(begin) > 1 and bool(last > begin.max() + FAR_ABOVE * np.ptp(begin) and last >= episode.rewards.max())


@dataclasses.dataclass(frozen=True)
class Stop:
    """What an episode earns that stops shortly before another one finishes."""

    step: int  # The first step that is different
    finishing: float  # The discounted rewards of the other one from that step on
    stopping: float  # Its own, up to the time limit
    per_step: float  # Its mean reward from that step on


def compare_returns(one: CheckedEpisode, two: CheckedEpisode, at: int, longest: int) -> Stop:
    """Compare an episode that finished with one that is the same for `at` steps. `longest`: the time limit [steps]."""
    rest = two.rewards[at:]
    to_come = 0 if two.has_ended else longest - two.steps
    later = rewards.discounted_steps(float(rest[-LATE:].mean()), to_come)
    stopping = rewards.discounted_sum(rest) + rewards.DISCOUNT ** len(rest) * later
    return Stop(at + 1, rewards.discounted_sum(one.rewards[at:]), stopping, float(rest.mean()))


def _judge_stops(finished: CheckedEpisode, stops: Sequence[Stop]) -> Iterator[ChildMessage]:
    if not stops:
        yield Skipped(RULE.id, "no episode that stops just before the goal could be played")
        return
    best = max(stops, key=lambda stop: stop.stopping - stop.finishing)
    if best.per_step > 0 and best.stopping > best.finishing + CLEARLY * abs(best.finishing):
        more = f"{best.per_step:.3g} per step instead, {best.stopping:.4g} in all (discount {rewards.DISCOUNT})"
        finishing = f"finishing at step {finished.steps} earns {best.finishing:.4g} from step {best.step} on"
        message = f"{finishing}; stopping there earns {more}"
        earned = {"value": best.stopping, "expected": f"below {best.finishing:.6g}", "per_step": best.per_step}
        yield RuleFinding(RULE, message, finished.at(best.step, **earned))


@judges_expressions(RULE, place=1, decides=False)  # after others: it plays much
def _read_incomes(notes: NotedEpisodes) -> Iterator[ChildMessage]:
    """Read what the source pays for success, and what it pays in each step next to the goal."""
    reader = notes.share(GoalReader)
    for summand, number, income in reader.find_replaced():
        message = f"success replaces the reward by {number:.4g}, and a step next to the goal pays up to {income:.4g}"
        evidence = {"value": number, "expected": f"above {income:.4g}"}
        yield RuleFinding(RULE, message, evidence, where=notes.reward.locate(summand.place))
        return
    successes = SuccessReader(notes)
    low = successes.find()
    if low is not None:
        message = (
            f"{ast.unparse(low.place.node)} (success) pays {low.success:.4g}, and a step next to the goal without it"
        )
        message += f" {low.before:.4g}" + (f", where only {low.lacks} is not true" if low.lacks else "")
        evidence = {"value": low.success, "expected": f"above {low.before:.4g}"}
        yield RuleFinding(RULE, message, evidence, where=notes.reward.locate(low.paid))
        return
    if not reader.ends_at_success():
        return
    income, bonus = successes.read_incomes() or (reader.read_income(), reader.read_bonus())
    if bonus is not None and income > 0:
        yield Fact(IN_SOURCE, (income, bonus, reader.pays_for_time()))


def _compare_in_source(records: Records) -> Iterator[RuleFinding]:
    if IN_SOURCE not in records.facts:
        return
    income, bonus, pays_for_time = records.facts[IN_SOURCE]
    steps = [one.steps for one in records.trajectories]
    longest = records.require_built().max_steps or max(steps, default=0)
    staying, whole = rewards.discounted_steps(income, longest), income * longest
    if _is_worth_more(staying, whole, bonus) or (pays_for_time and whole > bonus):
        message = f"success ends the episode and pays {bonus:.4g}; in the source, each step next to the goal pays"
        message += f" {income:.3g} or more, {whole:.4g} in {longest} steps, or {staying:.4g} with a discount of"
        message += f" {rewards.DISCOUNT}"
        yield RuleFinding(RULE, message, {"value": staying, "expected": f"below {bonus:.6g}", "per_step": income})
