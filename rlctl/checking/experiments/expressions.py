"""The experiment `expressions`: plays short episodes and notes what the expressions of the source are worth, for rules
that look at how numbers are computed."""

import ast
import contextlib
import dataclasses
import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from rlctl.checking.definitions import Definitions
from rlctl.checking.episode import EpisodePlayer, Moment
from rlctl.checking.experiment import INSTANCES, JudgeHook, experiment
from rlctl.checking.expressions import ExpressionRecorder, NotedCall, record_expressions
from rlctl.checking.instance import Context, EnvironmentRaised, Instance
from rlctl.checking.progress import read_clock
from rlctl.checking.records import FIRST_SEED, ChildMessage, Fact
from rlctl.checking.rule import NotApplicable, RuleFinding
from rlctl.checking.source_code import Function, SourceCode
from rlctl.checking.summands import RewardReader
from rlctl.checking.timed_expressions import TIMED, find_timed_expressions
from rlctl.checking.values import flatten
from rlctl.checking.vector_series import VectorSeries
from rlctl.checking.wrong_turns import TurnedVectors

Reader = TypeVar("Reader")
EPISODES = ("random", "zero", "extreme", "random", "rare")
"""How the actions of each episode are chosen."""
STEPS = 80  # of an episode
LONGEST_S = 10.0  # for episodes that are played again [s]
CHANGED = 1e-6  # relative and absolute: what differs by more has changed
MOST_NOTED = 300_000  # values; no episode begins after so many


@dataclasses.dataclass(frozen=True, eq=False)
class NotedEpisodes:
    """The expressions of a source, and what was noted of them, by episodes and their calls: the reset, and steps."""

    source: SourceCode
    episodes: Sequence[Sequence[NotedCall]]
    instance: Instance
    recorder: ExpressionRecorder
    _times: list[float] = dataclasses.field(default_factory=list)  # of what was played again [s]
    _shared: dict[Any, Any] = dataclasses.field(default_factory=dict)

    def play(self, number: int, steps: int, forced: Mapping[int, Mapping[int, Any]]) -> list[tuple[NotedCall, Moment]]:
        """Play an episode again for some steps, in which expressions are worth what is given, by steps and by their
        numbers. It ends where the environment raises an exception: what is forced may lead anywhere. Nothing is played
        where it took too long already."""
        kind = EPISODES[number]
        began = read_clock()
        if sum(self._times) > LONGEST_S:
            return []
        player = EpisodePlayer(self.instance, FIRST_SEED + number, kind, number=number, max_steps=steps)
        played: list[tuple[NotedCall, Moment]] = []
        try:
            while not player.ended or not played:
                self.recorder.forced = dict(forced.get(len(played), {}))
                with self.recorder.call(len(played)) as noted:
                    moment = player.step() if played else player.reset()
                played.append((noted, moment))
        except EnvironmentRaised:
            pass
        finally:
            self.recorder.forced = {}
            self._times.append(read_clock() - began)
        return played

    def changes_reward(self, number: int, step: int, one: Mapping[int, Any], other: Mapping[int, Any]) -> bool | None:
        """Say whether a step of an episode pays otherwise where expressions are worth what `other` has, instead of what
        `one` has; None where it cannot be played."""
        return self._differ(number, step, one, other, lambda moment: moment.reward_number)

    def changes_observation(
        self, number: int, step: int, one: Mapping[int, Any], other: Mapping[int, Any]
    ) -> bool | None:
        """Say the same of what a step shows."""
        return self._differ(number, step, one, other, lambda moment: flatten(moment.observation))

    def _differ(
        self, number: int, step: int, one: Mapping[int, Any], other: Mapping[int, Any], read: Callable[[Moment], Any]
    ) -> bool | None:
        played = [self.play(number, step, {step: values}) for values in (one, other)]
        if any(len(calls) <= step for calls in played):
            return None
        before, after = (np.asarray(read(calls[step][1]), np.float64) for calls in played)
        is_known = before.shape == after.shape and np.isfinite([before, after]).all()
        return not np.allclose(before, after, rtol=CHANGED, atol=CHANGED) if is_known else None

    def share(self, reader: Callable[["NotedEpisodes"], Reader]) -> Reader:
        """Return what a class reads of the episodes, which is made once for all judges."""
        if reader not in self._shared:
            self._shared[reader] = reader(self)
        found: Reader = self._shared[reader]
        return found

    @functools.cached_property
    def definitions(self) -> Definitions:
        """What defines the expressions."""
        return Definitions(self.source, self.episodes)

    @functools.cached_property
    def of_steps(self) -> Collection[ast.AST]:
        """The functions that steps run."""
        return self._list_run(self.steps)

    @functools.cached_property
    def of_resets(self) -> Collection[ast.AST]:
        """The functions that resets run."""
        return self._list_run([episode[0] for episode in self.episodes])

    @functools.cached_property
    def functions(self) -> list[Function]:
        """All functions of the source that were run."""
        return list(self._list_run([call for episode in self.episodes for call in episode]))

    @functools.cached_property
    def own_functions(self) -> list[Function]:
        """Those, and all methods of the environment's own classes: what builds it was not noted."""
        trees = self.source.trees.values()
        classes = [one for tree in trees for one in ast.walk(tree) if isinstance(one, ast.ClassDef)]
        own = [one for owner in classes if owner.name in self.source.classes for one in owner.body]
        return list(dict.fromkeys([*self.functions, *(one for one in own if isinstance(one, Function))]))

    def _list_run(self, calls: Sequence[NotedCall]) -> dict[Function, None]:
        return dict.fromkeys(self.source.expressions[number].function for call in calls for number in call.values)

    @functools.cached_property
    def steps(self) -> list[NotedCall]:
        """The steps of all episodes."""
        return [call for episode in self.episodes for call in episode[1:]]

    @functools.cached_property
    def turned(self) -> TurnedVectors:
        """The vectors that the source turns."""
        return TurnedVectors(VectorSeries(self.source, self.episodes))

    @functools.cached_property
    def reward(self) -> RewardReader:
        """What is added up to the reward."""
        author = self.source.author
        weights = {} if hasattr(author, "step") else getattr(author, "reward_weights", {})  # of a task
        return RewardReader(self.definitions, self.steps, weights)


BY_EXPRESSIONS = "findings by expressions"
"""The fact with findings that count where a rule has found nothing else: they may show the same mistake."""
judges_expressions = JudgeHook[NotedEpisodes]()
"""Shows the noted episodes of an instance."""


@contextlib.contextmanager
def noted_episodes(context: Context) -> Iterator[NotedEpisodes]:
    """Play short episodes with functions that note their expressions, as long as this lasts. The instance is a new one:
    what is forced may lead anywhere.

    Raises `NotApplicable` where there is no source.
    """
    with context.fresh() as instance:
        source = SourceCode(instance.env)
        if not source.expressions:
            raise NotApplicable("its source is that of a library, or cannot be read")
        with record_expressions(source) as recorder:
            yield NotedEpisodes(source, _play_all(instance, recorder), instance, recorder)


def _play_all(instance: Instance, recorder: ExpressionRecorder) -> list[list[NotedCall]]:
    episodes: list[list[NotedCall]] = []
    for number, kind in enumerate(EPISODES):
        player = EpisodePlayer(instance, FIRST_SEED + number, kind, number=number, max_steps=STEPS)
        with recorder.call(0) as noted:
            player.reset()
        episodes.append([noted])
        while not player.ended:
            with recorder.call(player.steps + 1) as noted:
                player.step()
            episodes[-1].append(noted)
        if recorder.total > MOST_NOTED or instance.context.budget.is_over():
            break
    return episodes


@experiment("expressions", INSTANCES, 35, share=3.0, hooks=(judges_expressions,))
def note_expressions(context: Context) -> Iterator[ChildMessage]:
    """Show what was noted to all judges."""
    with noted_episodes(context) as noted:
        yield Fact(TIMED, find_timed_expressions(noted.source, noted.episodes))
        shown = list(judges_expressions.judge(noted))
    yield Fact(BY_EXPRESSIONS, [message for message in shown if isinstance(message, RuleFinding)])
    yield from (message for message in shown if not isinstance(message, RuleFinding))
