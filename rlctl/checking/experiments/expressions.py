"""The experiment `expressions`: plays short episodes and notes what the expressions of the source are worth, for rules
that look at how numbers are computed."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.compared_ids import find_doubled_ids, find_wrong_ids
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.expressions import NotedCall, Source, record_expressions
from rlctl.checking.instance import Context
from rlctl.checking.observed_frames import find_world_vectors
from rlctl.checking.records import FIRST_SEED, ChildMessage, Fact
from rlctl.checking.rule import NotApplicable
from rlctl.checking.source_mistakes import MISTAKES, SourceMistake
from rlctl.checking.timed_expressions import TIMED, find_timed_expressions
from rlctl.checking.unread_actions import find_unread_elements
from rlctl.checking.vector_series import VectorSeries
from rlctl.checking.wrong_turns import TurnedVectors, find_wrong_turns

EPISODES = ("random", "zero", "extreme", "random", "rare")
"""How the actions of each episode are chosen."""
STEPS = 80  # of an episode
MOST_NOTED = 300_000  # values; no episode begins after so many


@dataclasses.dataclass(frozen=True, eq=False)
class NotedEpisodes:
    """The expressions of a source, and what was noted of them, by episodes and their calls: the reset, and steps."""

    source: Source
    episodes: Sequence[Sequence[NotedCall]]

    @property
    def steps(self) -> list[NotedCall]:
        """The steps of all episodes."""
        return [call for episode in self.episodes for call in episode[1:]]


judges_expressions = JudgeHook[NotedEpisodes]()
"""Shows the noted episodes of an instance."""


@experiment("expressions", PROBE, 104, share=0.2, hooks=(judges_expressions,))
def note_expressions(context: Context) -> Iterator[ChildMessage]:
    """Play short episodes with functions that note their expressions."""
    instance = context.instance
    source = Source(instance.env)
    if not source.expressions:
        raise NotApplicable("its source is that of a library, or cannot be read")
    episodes: list[list[NotedCall]] = []
    with record_expressions(source) as recorder:
        for number, kind in enumerate(EPISODES):
            player = EpisodePlayer(instance, FIRST_SEED + number, kind, number=number, max_steps=STEPS)
            with recorder.call(0) as noted:
                player.reset()
            episodes.append([noted])
            while not player.ended:
                with recorder.call(player.steps + 1) as noted:
                    player.step()
                episodes[-1].append(noted)
            if recorder.total > MOST_NOTED or context.budget.is_over():
                break
    yield Fact(TIMED, find_timed_expressions(source, episodes))
    size = int(np.prod(getattr(instance.env.action_space, "shape", None) or 0))
    yield Fact(MISTAKES, list(_find_mistakes(NotedEpisodes(source, episodes), size)))
    yield from judges_expressions.judge(NotedEpisodes(source, episodes))


def _find_mistakes(noted: NotedEpisodes, size: int) -> Iterator[SourceMistake]:
    """Yield the mistakes of lines, for the rules that other experiments judge, too; the action has `size` numbers."""
    source, numbers = noted.source, {number for call in noted.steps for number in call.values}
    evaluated = {source.expressions[number].function for number in numbers}
    turned = TurnedVectors(VectorSeries(source, noted.episodes))
    yield from find_wrong_turns(turned)
    yield from find_world_vectors(turned)
    yield from find_wrong_ids(source, noted.episodes)
    yield from find_doubled_ids(source, evaluated)
    yield from find_unread_elements(source, evaluated, size)
