"""Verifies an export: compares it with the policy per observation and in closed loop, and measures its latency."""

from __future__ import annotations

import dataclasses
import functools
import operator
import statistics
import timeit
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl import output
from rlctl.environments.dict_spaces import map_parts, stack, take_row
from rlctl.play.collect import Episode, play_episodes
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.play.workers import Workers
from rlctl.policy.actor import Rows, as_rows
from rlctl.policy.c_policy import CActor
from rlctl.policy.file import PolicyFile, Tensors
from rlctl.policy.onnx_policy import OnnxActor
from rlctl.policy.policy import Policy

if TYPE_CHECKING:
    from rlctl.policy.torch_policy import TorchActor

MAX_DIFFERENCE = 1e-5  # limit of |difference| of an action element; relative for elements larger than 1
MAX_RETURN_DIFFERENCE = 1e-3  # limit of the relative difference of an episode's return
_MIN_OBSERVATIONS = {"onnx": 1000, "c": 2000}
EPISODES = 20  # episodes that each of the two policies plays in closed loop
_LAST_BITS = 2.0**-21
"""Relative change: the last three bits of a float32, as much as another order of the additions in a network changes."""
_COPIES = 3  # of a policy, each with other last bits
_REPETITIONS = 300
_WARM_UP = 30
_CALLS = 10  # calls of a C function per measurement


@dataclasses.dataclass
class Agreement:
    """Differences of two policies on the same observations."""

    observations: int = 0
    max_difference: float = 0.0  # largest |difference| of an action element, in the units of the action
    beyond_limit: int = 0  # number of actions that differ by more than the limit; discrete actions that differ at all
    near_ties: int = 0
    """Number of different discrete actions whose logits are equal within the limit: both choices are correct."""
    batch_sizes: list[int] = dataclasses.field(default_factory=lambda: [1])
    """Numbers of observations per call of the exported policy."""

    @property
    def agrees(self) -> bool:
        """Whether no action differs by more than the limit."""
        return self.beyond_limit == 0


class Comparison:
    """Collects differences of the actions of a policy and its export."""

    def __init__(self, torch_actor: TorchActor, exported: OnnxActor | CActor) -> None:
        self.torch_actor, self.exported = torch_actor, exported
        self.agreement = Agreement()
        self._space = torch_actor.info.env.spaces()[1]
        self._logits: NDArray[np.float32]
        if not isinstance(self._space, spaces.Box):
            network: Any = torch_actor.network
            head = network.q_net.q_net[-1] if torch_actor.info.algo == "dqn" else network.action_net
            self._hook = head.register_forward_hook(self._keep_logits)

    def _keep_logits(self, module: Any, inputs: Any, output: Any) -> None:
        self._logits = output.detach().cpu().numpy()

    def add_episodes(self, episodes: Sequence[Episode]) -> None:
        """Compare the actions of both policies on all observations of episodes."""
        for episode in episodes:
            observations, length = episode.recorded.observations, len(episode.recorded.actions)
            row = Rows.one()
            self.torch_actor.begin(row)
            self.exported.begin(row)
            count = 1 if self.torch_actor.is_recurrent else length
            for low in range(0, length, count):
                batch = map_parts(operator.itemgetter(slice(low, low + count)), observations)
                steps = [map_parts(operator.itemgetter(slice(k, k + 1)), batch) for k in range(count)]
                actions = [self.exported.act(step, row)[1] for step in steps]
                self.add(self.torch_actor.act(batch, Rows.first(count))[1], np.concatenate(actions))
            self.agreement.observations += length

    def add_batch(self, exported: OnnxActor, episodes: Sequence[Episode]) -> None:
        """Compare the actions of both policies on the first observations of episodes, in one batch."""
        first = stack([take_row(episode.recorded.observations, 0) for episode in episodes])
        rows = Rows.first(len(episodes))
        self.torch_actor.begin(rows)
        self.add(self.torch_actor.act(first, rows)[1], exported.act_together(first))
        self.agreement.batch_sizes.append(len(episodes))

    def add(self, expected: NDArray[Any], actions: NDArray[Any]) -> None:
        """Compare two arrays of actions, shape (rows, ...); call it right after the torch policy has acted."""
        difference = np.abs(expected.astype(np.float64) - actions).reshape(len(expected), -1)
        # With this comparison NaN is beyond the limit.
        limit = MAX_DIFFERENCE * np.maximum(1.0, np.abs(expected)).reshape(difference.shape)
        differs = ~(difference <= limit).all(axis=1)
        if not isinstance(self._space, spaces.Box):
            for row in np.flatnonzero(differs).tolist():
                if self._is_near_tie(row, expected[row], actions[row]):
                    self.agreement.near_ties += 1
                    differs[row], difference[row] = False, 0.0
        self.agreement.max_difference = max(self.agreement.max_difference, float(difference.max()))
        self.agreement.beyond_limit += int(differs.sum())

    def _is_near_tie(self, row: int, expected: NDArray[Any], action: NDArray[Any]) -> bool:
        space, logits = self._space, self._logits[row]
        if isinstance(space, spaces.MultiBinary):  # compared with a logit of 0, a probability of 0.5
            return all(abs(float(logits[index])) <= MAX_DIFFERENCE for index in np.flatnonzero(expected != action))
        sizes = space.nvec if isinstance(space, spaces.MultiDiscrete) else [len(logits)]
        groups = np.split(logits, np.cumsum(sizes)[:-1])
        choices = zip(groups, np.atleast_1d(expected), np.atleast_1d(action), strict=True)
        return all(
            float(group[ours] - group[theirs]) <= MAX_DIFFERENCE * max(1.0, abs(float(group[ours])))
            for group, ours, theirs in choices
        )

    def close(self) -> None:
        """Stop reading logits."""
        if not isinstance(self._space, spaces.Box):
            self._hook.remove()


@dataclasses.dataclass(frozen=True)
class ClosedLoop:
    """Comparison of the same episodes, played with both policies."""

    episodes: int
    same_success: int | None  # number of episodes with the same success; None if the task reports no success
    same_length: int  # number of episodes with the same length
    max_return_difference: float  # relative to |return| of the episode or the mean |return|, whichever is larger
    mean_return: float
    mean_return_exported: float
    magnified: bool = False
    """Whether the episodes of the original policy differ as much when the last bits of its weights change."""
    repeats: bool = True
    """False if the original policy, played again, had other episodes: then whole episodes cannot be compared."""

    @property
    def is_conclusive(self) -> bool:
        """Whether a difference of the episodes would show that the policies differ."""
        return self.repeats and not self.magnified

    @property
    def agrees(self) -> bool:
        """Whether every episode had the same success and length, and a return within the limit."""
        same = self.same_success in (None, self.episodes) and self.same_length == self.episodes
        return same and self.max_return_difference <= MAX_RETURN_DIFFERENCE


@dataclasses.dataclass(frozen=True)
class Latency:
    """Median time for one observation [us]."""

    exported_us: float  # normalisation, network and bounds: ONNX is called from Python, C from C
    sb3_us: float  # SB3's `policy.predict` of a normalised observation

    @property
    def speedup(self) -> float:
        """Return the latency of SB3 divided by that of the file."""
        return self.sb3_us / self.exported_us


def verify(
    torch_actor: TorchActor, exported: OnnxActor | CActor, file: Path, workers: Workers
) -> tuple[Agreement, ClosedLoop]:
    """Play the same episodes with both policies, and compare their actions on every observation of both.

    `file` is the exported file, ONNX or a compiled library. Plays more episodes until enough observations are compared.
    If all actions agree but the episodes differ, the original policy plays again, to test whether the environment
    repeats its episodes, and whether they are chaotic. Raises `TaskError` if the environment fails.
    """
    min_observations = _MIN_OBSERVATIONS["onnx" if isinstance(exported, OnnxActor) else "c"]
    comparison = Comparison(torch_actor, exported)
    seeds = episode_seeds(0, Stream.VERIFY, EPISODES)
    workers.set_policy(torch_actor.file)
    with output.show_progress("closed loop, policy", len(seeds), "episodes") as show:
        expected = play_episodes(workers, seeds, record=True, watch=show)
    comparison.add_episodes(expected)
    if isinstance(exported, OnnxActor):
        comparison.add_batch(exported, expected)
    while (observations := comparison.agreement.observations) < min_observations:
        missing = max(1, round(1.1 * len(seeds) * (min_observations / observations - 1.0)))
        seeds = episode_seeds(0, Stream.VERIFY, len(seeds) + missing)
        with output.show_progress("more observations", missing, "episodes") as show:
            comparison.add_episodes(play_episodes(workers, seeds[-missing:], record=True, watch=show))
    workers.set_other_policy(str(file.resolve()))
    with output.show_progress("closed loop, exported file", EPISODES, "episodes") as show:
        actual = play_episodes(workers, seeds[:EPISODES], record=True, watch=show)
    comparison.add_episodes(actual)
    comparison.agreement.observations = observations  # counts the original policy's episodes only
    comparison.close()
    loop = compare_episodes(expected, actual)
    if comparison.agreement.agrees and not loop.agrees:
        different = list_different(expected, actual)
        repeats, magnified = _check_conclusive(torch_actor.file, workers, expected, different)
        loop = dataclasses.replace(loop, repeats=repeats, magnified=magnified)
    return comparison.agreement, loop


def list_different(expected: Sequence[Episode], actual: Sequence[Episode]) -> list[int]:
    """Return which episodes of the same seeds differ, those that differ most first.

    Only these are played again to find out why: an episode that did not differ has repeated itself.
    """
    pairs = [(ours.result, theirs.result) for ours, theirs in zip(expected, actual, strict=True)]
    same = [ours.success == theirs.success and ours.length == theirs.length for ours, theirs in pairs]
    differences = np.where(same, _compare_returns(expected, actual), np.inf)
    order = np.argsort(-differences, kind="stable").tolist()
    return [number for number in order if differences[number] > 0.0]


def changes_again(
    expected: Sequence[Episode],
    numbers: Sequence[int],
    play: Callable[[list[int]], Sequence[Episode]],
    together: int,
    *,
    exactly: bool,
) -> bool:
    """Return whether some episodes are others when `play` plays their seeds again, `together` at a time.

    It ends with the first that is another: `exactly`, or beyond the limits of `ClosedLoop.agrees`.
    """
    actual = list(expected)
    with output.show_progress("closed loop, policy again", len(numbers), "episodes") as show:
        for first in range(0, len(numbers), together):
            show(first)
            some = numbers[first : first + together]
            for number, episode in zip(some, play([expected[k].result.seed for k in some]), strict=True):
                actual[number] = episode
            loop = compare_episodes(expected, actual)
            if not loop.agrees or (exactly and loop.max_return_difference > 0.0):
                return True
    return False


def _check_conclusive(
    policy: PolicyFile, workers: Workers, expected: Sequence[Episode], different: Sequence[int]
) -> tuple[bool, bool]:
    """Return whether the policy repeats its episodes, and whether they change with the last bits of its weights.

    Contacts cause such changes within some hundred steps; the episodes cannot show whether two policies are the same.
    """

    def changes(policy: PolicyFile, *, exactly: bool) -> bool:
        workers.set_policy(policy)
        play = functools.partial(play_episodes, workers)
        return changes_again(expected, different, play, workers.n_envs, exactly=exactly)

    if changes(policy, exactly=True):
        return False, False
    others = (PolicyFile(policy.info, tensors) for tensors in change_last_bits(policy.tensors))
    return True, any(changes(other, exactly=False) for other in others)


def change_last_bits(tensors: Tensors) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield copies of a policy's tensors with other last bits, drawn for each element.

    Several, because the difference of chaotic episodes is a matter of chance: one copy may stay within the limit.
    """
    for seed in range(_COPIES):
        rng = np.random.default_rng(seed)
        yield {
            name: (values * rng.choice([1.0 - _LAST_BITS, 1.0 + _LAST_BITS], values.shape)).astype(values.dtype)
            if values.dtype.kind == "f"
            else values
            for name, values in tensors.items()
        }


def compare_episodes(expected: Sequence[Episode], actual: Sequence[Episode]) -> ClosedLoop:
    """Compare episodes of the same seeds."""
    pairs = [(ours.result, theirs.result) for ours, theirs in zip(expected, actual, strict=True)]
    returns = np.array([[ours.total_reward, theirs.total_reward] for ours, theirs in pairs])
    relative = _compare_returns(expected, actual)
    reports_success = any(result.success is not None for pair in pairs for result in pair)
    return ClosedLoop(
        episodes=len(pairs),
        same_success=sum(ours.success == theirs.success for ours, theirs in pairs) if reports_success else None,
        same_length=sum(ours.length == theirs.length for ours, theirs in pairs),
        max_return_difference=float(relative.max()),
        mean_return=float(returns[:, 0].mean()),
        mean_return_exported=float(returns[:, 1].mean()),
    )


def _compare_returns(expected: Sequence[Episode], actual: Sequence[Episode]) -> NDArray[np.float64]:
    """Return the difference of the returns of each episode, relative to |return|."""
    returns = np.array([[ours.result.total_reward for ours in expected], [ours.result.total_reward for ours in actual]])
    # Returns near 0 would have a large relative difference: they are compared with the mean |return|.
    scale = np.maximum(np.abs(returns).max(axis=0), np.abs(returns).mean())
    difference = np.abs(returns[0] - returns[1])
    return np.divide(difference, scale, out=np.zeros_like(difference), where=scale > 0)


def measure_latency(torch_actor: TorchActor, exported: OnnxActor | CActor) -> Latency:
    """Time both policies on one observation."""
    policy = Policy(exported)
    space = policy.observation_space
    space.seed(0)
    observation = space.sample()
    if isinstance(exported, CActor):
        exported_us = _measure_median_us(lambda: exported.repeat(observation, _CALLS)) / _CALLS
    else:
        exported_us = _measure_median_us(lambda: policy.predict(observation))
    return Latency(exported_us, measure_sb3(torch_actor))


def measure_sb3(torch_actor: TorchActor) -> float:
    """Return the time that SB3 takes for one normalised observation [us]."""
    space = torch_actor.info.env.spaces()[0]
    space.seed(0)
    normalized: Any = take_row(torch_actor.normalize(as_rows(space.sample())), 0)
    return _measure_median_us(lambda: torch_actor.network.predict(normalized, deterministic=True))


def _measure_median_us(call: Callable[[], Any]) -> float:
    return statistics.median(timeit.repeat(call, number=1, repeat=_WARM_UP + _REPETITIONS)[_WARM_UP:]) * 1e6
