"""Plays of environments whose bodies nobody may move: the goal comes to the robot instead, which does nothing."""

import dataclasses
from collections.abc import Callable

import numpy as np

from rlctl.checking.audit.play_world import Script
from rlctl.checking.audit.reaching import LONGEST_WAY, find_beside
from rlctl.checking.drawn_goals import TURNED, DrawnGoal, Numbers, Source
from rlctl.checking.experiments.commands import is_velocity, list_commands
from rlctl.checking.experiments.goals import find_drawn_goal, find_places
from rlctl.checking.goal_episodes import PLACED_STEPS, GoalEpisode, GoalTrials
from rlctl.checking.instance import Context
from rlctl.checking.records import FIRST_SEED
from rlctl.policy.actor import Actor

APPROACH = 50  # steps in which a goal comes
TRIED = 3  # times as many seeds as are played
SEEDS, STEPS = range(FIRST_SEED, FIRST_SEED + 4), 10
"""Of episodes, and their steps, in which it is compared what is paid."""


@dataclasses.dataclass(frozen=True)
class Lead:
    """What resets draw and a robot should follow, and where it does so while it does nothing."""

    trials: GoalTrials
    source: Source | None  # of the place where the goal is a success; None for a velocity: it stands, and follows 0

    def list_seeds(self, count: int) -> list[int]:
        """Return the seeds whose goals are farthest away, of several times as many: near ones are met by chance."""
        distances = {seed: self._measure_distance(seed) for seed in range(FIRST_SEED, FIRST_SEED + TRIED * count)}
        return sorted(distances, key=lambda seed: -distances[seed])[:count]

    def _measure_distance(self, seed: int) -> float:
        episode = GoalEpisode(self.trials, seed, "zero")
        if self.source is None:
            return float(np.linalg.norm(episode.goal))
        return episode.measure_distance(self.source)

    def prepare(self, actor: Actor, seed: int, longest: int, part: float = 0.0) -> Script:
        """Return the play of an episode in which the goal comes to the robot, up to a part of the way."""
        approach = 1 if self.source is None else max(1, min(APPROACH, int(LONGEST_WAY * longest)))
        coming = _Coming(self.trials, self._trace(seed, longest), approach, part)
        return Script(actor, coming.start, before=coming.move)

    def find_hover(self, seed: int) -> float | None:
        """Return the part of the way at which a goal is no success yet; None if it always is one."""
        source = self.source
        there = None if source is None else self.trials.find_place(source, seed, "zero")
        if source is None or there is None:
            return None
        way = GoalEpisode(self.trials, seed, "zero").goal - there

        def succeeds(part: float) -> bool:
            return bool(self.trials.succeeds(seed, there + part * way, source if source[1] else None, "zero"))

        return find_beside(succeeds)

    def _trace(self, seed: int, longest: int) -> list[Numbers]:
        """Return where the robot is after each step in which it does nothing."""
        source = self.source
        if source is None:
            return [np.zeros(self.trials.drawn.place.size)]
        episode = GoalEpisode(self.trials, seed, "zero")
        trace: list[Numbers] = []
        for _ in episode.follow([None] * longest):
            # To find a place that is observed in the robot's frame takes other episodes of as many steps.
            is_read = source[1] != TURNED or (len(trace) & (len(trace) - 1)) == 0
            trace.append(episode.read(source) if is_read else trace[-1])
        return trace


class _Coming:
    """Moves the goal of an episode from where it was drawn to where the robot is after each step."""

    def __init__(self, trials: GoalTrials, trace: list[Numbers], approach: int, part: float) -> None:
        self._place, self._env = trials.drawn.place, trials.instance.env
        self._trace, self._approach, self._part = trace, approach, part

    def start(self) -> None:
        """Note what was drawn."""
        self._attribute = self._place.find(self._env)
        self._drawn = self._place.pick(self._attribute)

    def move(self, step: int) -> None:
        """Put the goal where it should be after a step."""
        left = max(self._part, 1.0 - step / self._approach)
        there = self._trace[min(step, len(self._trace)) - 1]
        self._attribute = self._place.find_again(self._attribute, self._env)
        self._place.assign(self._attribute, there + left * (self._drawn - self._trace[0]), together=True)


def find_lead(context: Context) -> Lead | None:
    """Return the drawn goal of an environment, where one at the robot is a success; or else its drawn velocity."""
    instance = context.instance
    if not instance.accepts_seed:
        return None
    places, _ = find_places(instance)
    drawn = find_drawn_goal(context, places)
    lead = None if drawn is None else _find_goal(GoalTrials(instance, drawn))
    if lead is not None:
        return lead
    for place in list_commands(instance):
        trials = GoalTrials(instance, DrawnGoal(place, (), (), {}, {}))
        if is_velocity(place.name) and _pays_more_at_zero(trials):
            return Lead(trials, None)
    return None


def _find_goal(trials: GoalTrials) -> Lead | None:
    """Return the goal if the observation has a place at which it is a success for a robot that does nothing, and if it
    is paid for: the reward of other tasks is about something else."""
    episode = GoalEpisode(trials, FIRST_SEED, "zero", PLACED_STEPS)
    sources = [] if episode.has_ended else trials.list_sources(episode)
    source = next((one for one in sources if trials.is_success_at(one, "zero")), None)
    if source is None:
        return None

    def read(episode: GoalEpisode) -> Numbers:
        return episode.read(source)

    is_paid = any(_play(trials, seed) != _play(trials, seed, read) for seed in SEEDS)
    return Lead(trials, source) if is_paid else None


def _pays_more_at_zero(trials: GoalTrials) -> bool:
    """Say whether a robot that does nothing earns more with a command of 0 than with those that are drawn."""
    zero = np.zeros(trials.drawn.place.size)
    drawn, others = ([_play(trials, seed, read) for seed in SEEDS] for read in (None, lambda _: zero))
    return min(map(len, [*drawn, *others])) == STEPS and sum(map(sum, others)) > sum(map(sum, drawn))


def _play(trials: GoalTrials, seed: int, read: Callable[[GoalEpisode], Numbers] | None = None) -> list[float]:
    """Return what some steps without action pay, with the goal that was drawn or another one; fewer if it ends."""
    episode = GoalEpisode(trials, seed, "zero", PLACED_STEPS)
    goal = None if read is None or episode.has_ended else read(episode)
    return [step.reward for step in episode.play([goal] * STEPS)]
