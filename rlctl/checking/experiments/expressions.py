"""The experiment `expressions`: plays short episodes and notes what the expressions of the source are worth, for rules
that look at how numbers are computed."""

import ast
import contextlib
import dataclasses
import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.definitions import Definitions
from rlctl.checking.episode import EpisodePlayer, Moment
from rlctl.checking.experiment import INSTANCES, JudgeHook, experiment
from rlctl.checking.expressions import ExpressionRecorder, NotedCall, record_expressions
from rlctl.checking.instance import Context, EnvironmentRaised, Instance
from rlctl.checking.observed_frames import ObservedCode
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
CLEARLY = 10.0  # times the difference that the same episode has when it is played again
MOST_NOTED = 300_000  # values; no episode begins after so many


def read_reward(moment: Moment) -> NDArray[np.float64]:
    """Return the reward of a step as an array."""
    return np.array([moment.reward_number])


def read_observation(moment: Moment) -> NDArray[np.float64]:
    """Return the numbers that a step shows."""
    return np.asarray(flatten(moment.observation), np.float64)


def read_step(moment: Moment) -> NDArray[np.float64]:
    """Return what a step pays and shows, and whether it ends the episode."""
    return np.concatenate([read_reward(moment), moment.flags, read_observation(moment)])


def _compare(one: list[NDArray[np.float64]], other: list[NDArray[np.float64]], tolerance: float) -> float | None:
    """Return the largest difference of what both have, 0 within a tolerance; None where they cannot be compared."""
    pairs = list(zip(one, other, strict=False))
    if not pairs or not all(_are_comparable(before, after) for before, after in pairs):
        return None
    if all(np.allclose(*pair, rtol=tolerance, atol=tolerance, equal_nan=True) for pair in pairs):
        return 0.0
    return float(max(np.nanmax(np.abs(before - after)) for before, after in pairs))


def _are_comparable(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Say whether the same of both is finite, and something is."""
    if one.shape != other.shape:
        return False
    is_finite = np.isfinite(one)
    return bool(is_finite.any() and np.array_equal(is_finite, np.isfinite(other)))


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

    def changes(
        self,
        number: int,
        step: int,
        one: Mapping[int, Any],
        other: Mapping[int, Any],
        *,
        read: Callable[[Moment], NDArray[np.float64]] = read_reward,
        forced: Mapping[int, Mapping[int, Any]] = {},
        later: int = 0,
        tolerance: float = 0.0,
    ) -> bool | None:
        """Say whether something that is read of a step of an episode, or of so many later ones, is another where
        expressions are worth what `other` has in it, instead of what `one` has; None where that is not known, also
        where the same episode played once more is about as different.

        `forced` has values of other steps, `tolerance` is relative and absolute.
        """

        def look(values: Mapping[int, Any]) -> list[NDArray[np.float64]]:
            played = self.play(number, step + later, {**forced, step: values})
            return [read(moment) for _, moment in played[step:]]

        before, after = look(one), look(other)
        difference = _compare(before, after, tolerance)
        if not difference:
            return None if difference is None else False
        again = _compare(before, look(one), tolerance)
        return None if again is None or difference < CLEARLY * again else True

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
        return TurnedVectors(VectorSeries(self.source, self.episodes), self.definitions)

    @functools.cached_property
    def observed(self) -> ObservedCode:
        """The pieces of code of which an observation is made."""
        return ObservedCode(self.turned.series, self.definitions, self.turned.turns)

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


@experiment("expressions", INSTANCES, 35, share=3.0, hooks=(judges_expressions,), seeds_globals=True)
def note_expressions(context: Context) -> Iterator[ChildMessage]:
    """Show what was noted to all judges."""
    with noted_episodes(context) as noted:
        yield Fact(TIMED, find_timed_expressions(noted.source, noted.episodes))
        shown = list(judges_expressions.judge(noted))
    yield Fact(BY_EXPRESSIONS, [message for message in shown if isinstance(message, RuleFinding)])
    yield from (message for message in shown if not isinstance(message, RuleFinding))
