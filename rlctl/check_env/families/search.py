"""Records a small search for good actions, so that rules see more of an environment than chance finds.

All its episodes begin with the same seed, unless doing nothing succeeds with it. The cross-entropy method comes first:
generations of sequences of a few held actions, each drawn around the best of those before. Then the best sequence is
followed with another action from some step on; at last it stops shortly before its best moment, to see what standing
still beside a goal earns.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.actions import action_at, zero_action
from rlctl.check_env.episode import Episode
from rlctl.check_env.experiment import experiment
from rlctl.check_env.instance import Context
from rlctl.check_env.messages import FIRST_SEED, Message, Skipped, Trajectory
from rlctl.check_env.recording import Recording
from rlctl.check_env.rewarded import has_succeeded

MOST_STEPS = 6_000
"""Steps in all. With them the goal of the bundled `reach`, a ball of 5 cm within reach of an arm, is found from most
seeds; on a fast environment they take a tenth of a second."""
MOST_EPISODES = 60
MOST_SEEDS = 3
LONGEST = 200
"""An episode is left after so many steps: most of a goal's pull shows before."""
SEGMENTS = 3
"""Of a sequence, each one action that is held: few numbers to search among."""
GENERATION = 10
ELITE = 3
WIDTH = 0.3
"""Of the first generation, as a standard deviation; the range of an action is 1."""
LEAST_WIDTH = 0.025
STRETCH = 1.5
"""How long a sequence's actions reach, against the longest episode so far."""
CEM_FRACTION = 0.7
"""Part of the steps that is for generations; after a success there is no need for another."""
CONTINUED = 12
"""Episodes that follow the best and then go on otherwise."""
STOPS = (1, 2, 4, 8)
"""How many steps before its best moment, or its end, an episode is played again with nothing done from there on."""


@dataclasses.dataclass
class _Attempt:
    """One episode of the search."""

    sequence: list[Any]
    played: Trajectory

    @property
    def score(self) -> float:
        """Mean reward over the time there was, and the best of it: to come near counts, even for a moment."""
        rewards = np.nan_to_num(self.played.rewards)
        return float(rewards.sum() / LONGEST + rewards.max()) if rewards.size else -np.inf


@experiment("search", share=3.0)
def search(context: Context) -> Iterator[Message]:
    """Look for action sequences with a high return, and stand still near the best moments of them."""
    leaves = context.instance.action_leaves
    unknown = [leaf.kind for leaf in leaves if not leaf.supported]
    if unknown or not leaves:
        yield Skipped("search", f"no search among actions of a {', '.join(unknown) or 'space without numbers'}")
        return
    searcher = _Search(context)
    yield from searcher.do_nothing()
    yield from searcher.cross_entropy_search()
    yield from searcher.perturb_best()
    yield from searcher.stop_early()
    if context.budget.why_spent:
        yield Skipped("search", f"{len(searcher.attempts)} episodes were searched: {context.budget.why_spent}")


class _Search:
    def __init__(self, context: Context) -> None:
        self.instance = context.instance
        self.budget = context.budget
        self.attempts: list[_Attempt] = []
        self._seed = FIRST_SEED
        self._rng = np.random.default_rng(FIRST_SEED)
        self._space = self.instance.env.action_space
        self._length = LONGEST
        self._size = sum(int(np.prod(leaf.shape)) for leaf in self.instance.action_leaves)

    def do_nothing(self) -> Iterator[Message]:
        """Play with zero actions, and stay with the first seed where that does not succeed."""
        for seed in range(FIRST_SEED, FIRST_SEED + MOST_SEEDS):
            self._seed = seed
            yield from self.play([zero_action(self._space)] * self._length, "zero")
            if not has_succeeded(self.attempts[-1].played) or not self._goes_on():
                return

    def cross_entropy_search(self) -> Iterator[Message]:
        """Play generations of held actions, each around the best of the one before."""
        shape = (SEGMENTS, self._size)
        mean, width = np.full(shape, 0.5), np.full(shape, WIDTH)
        best, best_score = mean, -np.inf
        while self._goes_on(CEM_FRACTION) and not any(has_succeeded(each.played) for each in self._of_seed):
            generation: list[tuple[float, NDArray[np.float64]]] = []
            for number in range(GENERATION):
                centre, spread = (best, WIDTH * width) if number == 0 else (mean, width)
                parameters = np.clip(centre + spread * self._rng.standard_normal(shape), 0.0, 1.0)
                yield from self.play(self._hold(parameters))
                generation.append((self.attempts[-1].score, parameters))
                if not self._goes_on(CEM_FRACTION):
                    break
            generation.sort(key=lambda each: -each[0])
            if generation[0][0] > best_score:
                best_score, best = generation[0]
            elite = np.stack([parameters for _, parameters in generation[:ELITE]])
            mean, width = elite.mean(axis=0), np.maximum(elite.std(axis=0), LEAST_WIDTH)

    def perturb_best(self) -> Iterator[Message]:
        """Follow the best sequence and hold another action from some step on."""
        for _ in range(CONTINUED):
            if not self._goes_on():
                return
            best = max(self._of_seed, key=lambda each: each.score)
            at = int(best.played.steps * np.sqrt(self._rng.random()))  # rather late than early
            action = action_at(self._space, self._rng.random(self._size))
            yield from self.play([*best.sequence[:at], *[action] * (self._length - at)])

    def stop_early(self) -> Iterator[Message]:
        """Follow the sequences that finished, or else the best, and do nothing from shortly before on."""
        followed = [each for each in self._of_seed if each.played.steps]
        if not followed:
            return
        ended = [each for each in followed if each.played.ended == "terminated"]
        finished = [each for each in ended if has_succeeded(each.played)] or ended
        chosen = [max(finished, key=lambda each: each.played.rewards[-1])] if finished else []
        chosen.append(max(followed, key=lambda each: each.score))
        nothing = zero_action(self._space)
        for each in chosen:
            is_over, rewards = each.played.ended == "terminated", np.nan_to_num(each.played.rewards)
            for before in STOPS:
                at = max(0, (len(rewards) if is_over else int(rewards.argmax()) + 1) - before)
                if self._goes_on():
                    yield from self.play([*each.sequence[:at], *[nothing] * (self._length - at)])

    def play(self, sequence: list[Any], kind: str = "searched") -> Iterator[Message]:
        """Play one sequence of actions."""
        given = (copy.deepcopy(action) for action in sequence)
        deadline = self.budget.end_within(max(0.0, self.budget.seconds_left / 4))
        number, steps = len(self.attempts), len(sequence)
        episode = Episode(
            self.instance, self._seed, kind, number=number, max_steps=steps, deadline=deadline, given=given
        )
        recording = Recording("search", episode, self.budget)
        yield from recording.run()
        played = recording.trajectory
        self.attempts.append(_Attempt(sequence, played))
        if played.ended in ("truncated", "both"):
            self._length = min(self._length, played.steps)

    @property
    def _of_seed(self) -> list[_Attempt]:
        """The attempts with the seed that is searched with, which can be followed again."""
        return [each for each in self.attempts if each.played.seed == self._seed]

    def _hold(self, parameters: NDArray[np.float64]) -> list[Any]:
        actions = [action_at(self._space, each) for each in parameters]
        # Where episodes end soon the actions have to change soon.
        longest = max(each.played.steps for each in self.attempts)
        segment = max(2, min(self._length, round(STRETCH * longest)) // SEGMENTS)
        return [actions[min(SEGMENTS - 1, step // segment)] for step in range(self._length)]

    def _goes_on(self, part: float = 1.0) -> bool:
        steps = sum(each.played.steps for each in self.attempts)
        is_left = steps < part * MOST_STEPS and len(self.attempts) < part * MOST_EPISODES
        return is_left and not self.budget.why_spent
