"""Records a small search for good actions, so that rules see more of an environment than chance finds; and RL605.

All its episodes have the same seed. The first does nothing. The cross-entropy method plays generations of sequences of
a few held actions, drawn around the best sequences of the generation before. Then the best sequence is repeated with
another action from some step on; at last a finished one stops shortly before its end, next to the goal.
"""

import copy
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer, action_at, zero_action
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.families import rewards
from rlctl.checking.families.reset import play_after_ends
from rlctl.checking.instance import Context
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, CheckedEpisode, ChildMessage, Shortened, Skipped
from rlctl.checking.rule import NotJudged, RuleFinding

MOST_STEPS, MOST_EPISODES = 4_500, 60  # in all: they find the goal of the bundled `reach` from most seeds
ENOUGH_EPISODES, STEPS_AFTER = 11, 2_000  # Of a slow environment; of the episodes after the search
LONGEST = 150  # episodes are stopped after so many steps; a reward that leads to a goal shows before
SEGMENTS = 3  # Of a sequence, each one action that is held: few numbers to search among
GENERATION, ELITE = 10, 3  # Sequences; the best of them
WIDTH, LEAST_WIDTH = 0.3, 0.025  # Standard deviation, first and least; the range of an action is 1
STRETCH = 1.5  # How long a sequence's actions reach, against the longest episode so far
CEM_FRACTION = 0.7  # part of the steps that is for generations
CONTINUED = 12  # Episodes that follow the best and then go on otherwise
STOPS = (1, 2, 4, 8)  # steps before the end of a finished episode, to stop there
FAR_ABOVE = 5.0  # times the spread of early rewards; a robot that falls at speed ends with a good reward
CLEARLY = 0.1  # How much more stopping has to earn than finishing
LATE = 10  # steps after the recorded ones are assumed to earn the mean of the last so many rewards


@dataclasses.dataclass
class _Attempt:
    sequence: list[Any]
    played: CheckedEpisode

    @property
    def score(self) -> float:
        """Mean reward over the time there was, and the best of it: to come near counts, even for a moment."""
        rewards = np.nan_to_num(self.played.rewards)
        return float(rewards.sum() / LONGEST + rewards.max()) if rewards.size else -np.inf


@experiment("search", PROBE, 70, "RL605", share=6.0)
def search(context: Context) -> Iterator[ChildMessage]:
    """Look for action sequences with a high return, and stop one that finished shortly before its end."""
    leaves = context.instance.action_leaves
    unknown = [leaf.kind for leaf in leaves if not leaf.supported]
    if unknown or not leaves:
        raise NotJudged(f"no search among actions of a {', '.join(unknown) or 'space without numbers'}")
    searcher = _Search(context)
    yield from searcher.play([zero_action(context.instance.env.action_space)] * LONGEST, "zero")
    yield from searcher.cross_entropy_search()
    yield from searcher.perturb_best()
    yield from searcher.stop_early()
    first = next((attempt.sequence[: attempt.played.steps] for attempt in searcher.succeeded), None)
    yield from play_after_ends(context, first)
    if why := context.budget.why_spent():
        yield Skipped("search", f"{len(searcher.attempts)} episodes were searched: {why}")
    elif searcher.is_shortened:
        yield Shortened("search", f"{len(searcher.attempts)} searched episodes")


class _Search:
    def __init__(self, context: Context) -> None:
        self.instance = context.instance
        self.budget = context.budget
        self.attempts: list[_Attempt] = []
        self.is_shortened = False  # because the environment is slow
        self._rng = np.random.default_rng(FIRST_SEED)
        self._space = self.instance.env.action_space
        self._length = LONGEST
        self._size = sum(int(np.prod(leaf.shape)) for leaf in self.instance.action_leaves)

    @property
    def succeeded(self) -> list[_Attempt]:
        return [attempt for attempt in self.attempts if rewards.has_succeeded(attempt.played)]

    def cross_entropy_search(self) -> Iterator[ChildMessage]:
        shape = (SEGMENTS, self._size)
        mean, width = np.full(shape, 0.5), np.full(shape, WIDTH)
        best, best_score = mean, -np.inf
        while self._goes_on(CEM_FRACTION) and not self.succeeded:
            generation: list[tuple[float, NDArray[np.float64]]] = []
            for number in range(GENERATION):
                centre, spread = (best, WIDTH * width) if number == 0 else (mean, width)
                parameters = np.clip(centre + spread * self._rng.standard_normal(shape), 0.0, 1.0)
                yield from self.play(self._hold(parameters))
                generation.append((self.attempts[-1].score, parameters))
                if not self._goes_on(CEM_FRACTION):
                    break
            generation.sort(key=lambda scored: -scored[0])
            if generation[0][0] > best_score:
                best_score, best = generation[0]
            elite = np.stack([parameters for _, parameters in generation[:ELITE]])
            mean, width = elite.mean(axis=0), np.maximum(elite.std(axis=0), LEAST_WIDTH)

    def perturb_best(self) -> Iterator[ChildMessage]:
        for _ in range(CONTINUED):
            if not self._goes_on():
                return
            best = max(self.attempts, key=lambda attempt: attempt.score)
            at = int(best.played.steps * np.sqrt(self._rng.random()))  # rather late than early
            action = action_at(self._space, self._rng.random(self._size))
            yield from self.play([*best.sequence[:at], *[action] * (self._length - at)])

    def stop_early(self) -> Iterator[ChildMessage]:
        is_reported = rewards.reports_success([attempt.played for attempt in self.attempts])
        finished = [attempt for attempt in self.attempts if _finishes(attempt.played, is_reported)]
        if not finished:
            yield Skipped("RL605", "no searched episode ended in success", applies=False)
            return
        best = max(finished, key=lambda attempt: attempt.played.rewards[-1])
        one, nothing = best.played, zero_action(self._space)
        stops: list[Stop] = []
        for before in STOPS:
            at = max(0, one.steps - before)
            if self._goes_on():
                yield from self.play([*best.sequence[:at], *[nothing] * (self._length - at)])
                two = self.attempts[-1].played
                is_same = np.array_equal(one.rewards[:at], two.rewards[:at]) and two.ended != "raised"
                if is_same and two.steps > one.steps and not _finishes(two, is_reported):
                    longest = self.instance.max_steps or max(attempt.played.steps for attempt in self.attempts)
                    stops.append(compare_returns(one, two, at, longest))
        if not is_reported:
            stops = [stop for stop in stops if stop.finishing > 0]  # an end that costs more than it pays is no goal
        yield from _judge_stops(one, stops)

    def play(self, sequence: list[Any], kind: str = "searched") -> Iterator[ChildMessage]:
        copies = (copy.deepcopy(action) for action in sequence)
        number, steps = len(self.attempts), len(sequence)
        episode = EpisodePlayer(self.instance, FIRST_SEED, kind, number=number, max_steps=steps, sequence=copies)
        recording = Recording("search", episode)
        yield from recording.run()
        played = recording.trajectory
        self.attempts.append(_Attempt(sequence, played))
        if played.ended in ("truncated", "both"):
            self._length = min(self._length, played.steps)

    def _hold(self, parameters: NDArray[np.float64]) -> list[Any]:
        actions = [action_at(self._space, parameter) for parameter in parameters]
        # Where episodes end soon the actions have to change soon.
        longest = max(attempt.played.steps for attempt in self.attempts)
        segment = max(2, min(self._length, round(STRETCH * longest)) // SEGMENTS)
        return [actions[min(SEGMENTS - 1, step // segment)] for step in range(self._length)]

    def _goes_on(self, part: float = 1.0) -> bool:
        steps = sum(attempt.played.steps for attempt in self.attempts)
        is_left = steps < part * MOST_STEPS and len(self.attempts) < part * MOST_EPISODES
        if is_left and len(self.attempts) >= ENOUGH_EPISODES and self.budget.seconds_left < self._time_after():
            self.is_shortened = True
            return False
        return is_left and not self.budget.why_spent()

    def _time_after(self) -> float:
        """Return how long the episodes after the search take [s], about: their rule needs whole ones."""
        return STEPS_AFTER * (self.instance.progress.mean_s("step") or 0.0)


def _finishes(episode: CheckedEpisode, success_is_reported: bool) -> bool:
    if episode.ended not in ("terminated", "both"):
        return False
    if success_is_reported:
        return rewards.ends_in_success(episode)
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
        yield Skipped("RL605", "no episode that stops just before the goal could be played")
        return
    best = max(stops, key=lambda stop: stop.stopping - stop.finishing)
    if best.per_step > 0 and best.stopping > best.finishing + CLEARLY * abs(best.finishing):
        more = f"{best.per_step:.3g} per step instead, {best.stopping:.4g} in all (discount {rewards.DISCOUNT})"
        finishing = f"finishing at step {finished.steps} earns {best.finishing:.4g} from step {best.step} on"
        message = f"{finishing}; stopping there earns {more}"
        earned = {"value": best.stopping, "expected": f"below {best.finishing:.6g}", "per_step": best.per_step}
        yield RuleFinding("RL605", message, finished.at(best.step, **earned))
