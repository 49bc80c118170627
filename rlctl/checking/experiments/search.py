"""The experiment `search`: a small search for good actions, so that rules see more of an environment than chance finds.

All its episodes have the same seed. The first does nothing. The cross-entropy method plays generations of sequences of
a few held actions, drawn around the best sequences of the generation before. Then the best sequence is repeated with
another action from some step on; at last the rules play what they need, such as a finished episode that stops shortly
before its end, next to the goal.
"""

import copy
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import rewards
from rlctl.checking.episode import EpisodePlayer, action_at, zero_action
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.instance import Context
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, CheckedEpisode, ChildMessage, Shortened, Skipped
from rlctl.checking.rule import NotJudged

MOST_STEPS, MOST_EPISODES = 4_500, 60  # in all: they find the goal of the bundled `reach` from most seeds
ENOUGH_EPISODES, STEPS_AFTER = 11, 2_000  # Of a slow environment; of the episodes after the search
LONGEST = 150  # episodes are stopped after so many steps; a reward that leads to a goal shows before
SEGMENTS = 3  # Of a sequence, each one action that is held: few numbers to search among
GENERATION, ELITE = 10, 3  # Sequences; the best of them
WIDTH, LEAST_WIDTH = 0.3, 0.025  # Standard deviation, first and least; the range of an action is 1
STRETCH = 1.5  # How long a sequence's actions reach, against the longest episode so far
CEM_FRACTION = 0.7  # part of the steps that is for generations
CONTINUED = 12  # Episodes that follow the best and then go on otherwise


@dataclasses.dataclass
class Attempt:
    """A sequence of actions, and the episode that was played with it."""

    sequence: list[Any]
    played: CheckedEpisode

    @property
    def score(self) -> float:
        """Mean reward over the time there was, and the best of it: to come near counts, even for a moment."""
        rewards = np.nan_to_num(self.played.rewards)
        return float(rewards.sum() / LONGEST + rewards.max()) if rewards.size else -np.inf


judges_searches = JudgeHook["ActionSearch"]()
"""Shows a search that has ended, with which the parts play further episodes."""


@experiment("search", PROBE, 70, share=6.0, hooks=(judges_searches,))
def search(context: Context) -> Iterator[ChildMessage]:
    """Look for action sequences with a high return, and play what rules need of them."""
    leaves = context.instance.action_leaves
    unknown = [leaf.kind for leaf in leaves if not leaf.supported]
    if unknown or not leaves:
        raise NotJudged(f"no search among actions of a {', '.join(unknown) or 'space without numbers'}")
    searcher = ActionSearch(context)
    yield from searcher.play([zero_action(context.instance.env.action_space)] * LONGEST, "zero")
    yield from searcher.cross_entropy_search()
    yield from searcher.perturb_best()
    yield from judges_searches.judge(searcher)
    if why := context.budget.why_spent():
        yield Skipped("search", f"{len(searcher.attempts)} episodes were searched: {why}")
    elif searcher.is_shortened:
        yield Shortened("search", f"{len(searcher.attempts)} searched episodes")


class ActionSearch:
    """Plays sequences of actions with the first seed."""

    def __init__(self, context: Context) -> None:
        self.context, self.instance = context, context.instance
        self.budget = context.budget
        self.attempts: list[Attempt] = []
        self.is_shortened = False  # because the environment is slow
        self._rng = np.random.default_rng(FIRST_SEED)
        self.space = self.instance.env.action_space
        self.length = LONGEST
        self._size = sum(int(np.prod(leaf.shape)) for leaf in self.instance.action_leaves)

    @property
    def succeeded(self) -> list[Attempt]:
        """The attempts with a success."""
        return [attempt for attempt in self.attempts if rewards.has_succeeded(attempt.played)]

    def cross_entropy_search(self) -> Iterator[ChildMessage]:
        """Play generations of sequences until one succeeds."""
        shape = (SEGMENTS, self._size)
        mean, width = np.full(shape, 0.5), np.full(shape, WIDTH)
        best, best_score = mean, -np.inf
        while self.goes_on(CEM_FRACTION) and not self.succeeded:
            generation: list[tuple[float, NDArray[np.float64]]] = []
            for number in range(GENERATION):
                centre, spread = (best, WIDTH * width) if number == 0 else (mean, width)
                parameters = np.clip(centre + spread * self._rng.standard_normal(shape), 0.0, 1.0)
                yield from self.play(self._hold(parameters))
                generation.append((self.attempts[-1].score, parameters))
                if not self.goes_on(CEM_FRACTION):
                    break
            generation.sort(key=lambda scored: -scored[0])
            if generation[0][0] > best_score:
                best_score, best = generation[0]
            elite = np.stack([parameters for _, parameters in generation[:ELITE]])
            mean, width = elite.mean(axis=0), np.maximum(elite.std(axis=0), LEAST_WIDTH)

    def perturb_best(self) -> Iterator[ChildMessage]:
        """Repeat the best sequence with another action from some step on."""
        for _ in range(CONTINUED):
            if not self.goes_on():
                return
            best = max(self.attempts, key=lambda attempt: attempt.score)
            at = int(best.played.steps * np.sqrt(self._rng.random()))  # rather late than early
            action = action_at(self.space, self._rng.random(self._size))
            yield from self.play([*best.sequence[:at], *[action] * (self.length - at)])

    def play(self, sequence: list[Any], kind: str = "searched") -> Iterator[ChildMessage]:
        """Play a sequence of actions, as the last attempt."""
        copies = (copy.deepcopy(action) for action in sequence)
        number, steps = len(self.attempts), len(sequence)
        episode = EpisodePlayer(self.instance, FIRST_SEED, kind, number=number, max_steps=steps, sequence=copies)
        recording = Recording("search", episode)
        yield from recording.run()
        played = recording.trajectory
        self.attempts.append(Attempt(sequence, played))
        if played.ended in ("truncated", "both"):
            self.length = min(self.length, played.steps)

    def _hold(self, parameters: NDArray[np.float64]) -> list[Any]:
        actions = [action_at(self.space, parameter) for parameter in parameters]
        # Where episodes end soon the actions have to change soon.
        longest = max(attempt.played.steps for attempt in self.attempts)
        segment = max(2, min(self.length, round(STRETCH * longest)) // SEGMENTS)
        return [actions[min(SEGMENTS - 1, step // segment)] for step in range(self.length)]

    def goes_on(self, part: float = 1.0) -> bool:
        """Say whether there is time and memory for another episode in a part of the search."""
        steps = sum(attempt.played.steps for attempt in self.attempts)
        is_left = steps < part * MOST_STEPS and len(self.attempts) < part * MOST_EPISODES
        if is_left and len(self.attempts) >= ENOUGH_EPISODES and self.budget.seconds_left < self._time_after():
            self.is_shortened = True
            return False
        return is_left and not self.budget.why_spent()

    def _time_after(self) -> float:
        """Return how long the episodes after the search take [s], about: their rule needs whole ones."""
        return STEPS_AFTER * (self.instance.progress.mean_s("step") or 0.0)
