"""Plays one episode of an untrusted environment. Only this module resets and steps in a loop."""

import copy
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.checking.instance import Instance
from rlctl.checking.progress import read_clock
from rlctl.checking.values import flatten_action, name_type, read_flag
from rlctl.environments.leaves import Leaf, Path, find_leaves

_DRAWN_AT_ONCE = 64  # samples
HOLD_STEPS, RARE = 10, 0.1  # How long an extreme action is held; how often a rare action is not zero


@dataclasses.dataclass(frozen=True)
class Moment:
    """What one call of reset or step was given and returned."""

    step: int  # 0 is the reset
    action: Any
    observation: Any
    reward: Any = 0.0
    terminated: Any = False
    truncated: Any = False
    info: Any = dataclasses.field(default_factory=dict)
    form: str = ""  # of a wrong return value: `tuple of 4`, `NoneType`
    is_readable: bool = True  # False if step returned something that cannot be unpacked
    changes_action: bool = False  # Whether step wrote into the action that it was given

    @property
    def flags(self) -> tuple[bool, bool]:
        """What `terminated` and `truncated` mean, whatever their types."""
        return read_flag(self.terminated), read_flag(self.truncated)

    @property
    def reward_number(self) -> float:
        """The reward as a number; NaN for what is none, which is RL204's matter."""
        try:
            return float(self.reward)
        except (TypeError, ValueError):
            return math.nan


@dataclasses.dataclass(eq=False)
class EpisodePlayer:
    """One episode. Iterating over it resets, and steps until it ends or must end; each call is a `Moment`. If the
    environment raises, iterating raises `EnvironmentRaised`. `reset` and `step` may be called directly too."""

    instance: Instance
    seed: int
    actions: str = "random"  # A kind (see `draw_actions`), or the name of the `sequence`
    _: dataclasses.KW_ONLY
    number: int = 0
    action_seed: int | None = None  # `seed` by default
    max_steps: int = 10_000
    longest_s: float = float("inf")  # The episode also ends when the experiment's time is over
    sequence: Iterable[Any] | None = None

    def __post_init__(self) -> None:
        self._began = read_clock()
        self.steps = 0
        self.ended = ""
        """`terminated`, `truncated`, `both`, or what cut it: `steps`, `time`, `raised` (a wrong return value)."""

    def __iter__(self) -> Iterator[Moment]:
        yield self.reset()
        while not self.ended:
            yield self.step()

    def reset(self) -> Moment:
        """Begin the episode."""
        self.resume(0)
        returned = self.instance.reset(self.seed, self.number)
        if isinstance(returned, tuple) and len(returned) == 2:
            return Moment(0, None, returned[0], info=returned[1])
        return Moment(0, None, returned, form=_form(returned))

    def resume(self, steps: int) -> None:
        """Go on without a reset, after so many steps: for who has put the environment back to its state then."""
        self.steps, self.ended = steps, "" if steps < self.max_steps else "steps"
        space, seed = self.instance.env.action_space, self.seed if self.action_seed is None else self.action_seed
        drawn = draw_actions(space, self.actions, seed) if self.sequence is None else self.sequence
        self._next: Iterator[Any] = itertools.islice(drawn, steps, None)

    def step(self) -> Moment:
        """Take one step."""
        self.steps += 1
        call, env = self.instance.call, self.instance.env
        action = call("sample", next, self._next, step=self.steps)
        given = copy.deepcopy(action)
        moment = self._read(action, call("step", env.step, given, step=self.steps))
        if _is_changed(self.instance.action_leaves, action, given):
            moment = dataclasses.replace(moment, changes_action=True)
        terminated, truncated = moment.flags
        if not moment.is_readable:
            self.ended = "raised"
        elif terminated and truncated:
            self.ended = "both"
        elif terminated or truncated:
            self.ended = "terminated" if terminated else "truncated"
        elif self.steps >= self.max_steps:
            self.ended = "steps"
        elif self._is_late():
            self.ended, self.instance.context.budget.was_cut = "time", True
        return moment

    def _is_late(self) -> bool:
        budget, now = self.instance.context.budget, read_clock()
        growth = budget.growth()
        return now > budget.ends(budget.deadline) or now > self._began + self.longest_s * growth

    def _read(self, action: Any, returned: Any) -> Moment:
        if isinstance(returned, tuple) and len(returned) == 5:
            return Moment(self.steps, action, *returned)
        form = _form(returned)
        if isinstance(returned, tuple) and len(returned) == 4:
            observation, reward, done, info = returned
            return Moment(self.steps, action, observation, reward, done, False, info, form)
        return Moment(self.steps, action, None, form=form, is_readable=False)


def _is_changed(leaves: list[Leaf], action: Any, given: Any) -> bool:
    if isinstance(action, np.ndarray) and action.tobytes() == given.tobytes():
        return False  # the usual case, in a tenth of the time
    try:
        return not np.array_equal(flatten_action(leaves, action), flatten_action(leaves, given), equal_nan=True)
    except LookupError:  # step took a part of it out
        return True


def _form(returned: Any) -> str:
    return name_type(returned) + (f" of {len(returned)}" if isinstance(returned, tuple) else "")


def draw_actions(space: spaces.Space[Any], kind: str, seed: int) -> Iterator[Any]:
    """Yield actions without end: `random`, `zero`, `repeated` (a random one, always the same), `rare` (zero but now and
    then), or `extreme` (corners of the space, each held for a while)."""
    # A copy: the environment's own space has a generator that it may use, or share with other instances.
    space = copy.deepcopy(space)
    space.seed(seed)
    rng = np.random.default_rng(seed)
    samples = _draw_samples(space)
    repeated = next(samples) if kind == "repeated" else None
    while True:
        if kind == "random" or (kind == "rare" and rng.random() < RARE):
            yield next(samples)
        elif kind in ("zero", "rare"):
            yield zero_action(space)
        elif kind == "repeated":
            yield copy.deepcopy(repeated)
        else:
            corner = build_action(space, lambda leaf: _corner(leaf, rng))
            for _ in range(HOLD_STEPS):
                yield copy.deepcopy(corner)


def _draw_samples(space: spaces.Space[Any]) -> Iterator[Any]:
    """Yield samples without end; those of a bounded box are drawn many at once: one alone is slow."""
    if type(space) is spaces.Box and space.shape and space.dtype.kind == "f" and space.is_bounded():
        while True:
            rows = space.np_random.uniform(space.low, space.high, (_DRAWN_AT_ONCE, *space.shape))
            yield from rows.astype(space.dtype)
    while True:
        yield space.sample()


def build_action(space: spaces.Space[Any], value_of: Callable[[Leaf], Any], path: Path = ()) -> Any:
    """Return an action with what a function gives for each leaf of the space; a sample where that is None."""
    if isinstance(space, spaces.Dict):
        return {key: build_action(part, value_of, (*path, key)) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(build_action(part, value_of, (*path, i)) for i, part in enumerate(space.spaces))
    (leaf,) = find_leaves(space, path)
    if (value := value_of(leaf)) is None:
        return space.sample()
    if not leaf.supported:
        return value
    return int(value) if leaf.kind == "Discrete" else np.asarray(value).astype(leaf.dtype)


def zero_action(space: spaces.Space[Any]) -> Any:
    """Return the action that is nearest to doing nothing: zeros, or what is nearest to them."""
    return build_action(space, lambda leaf: np.clip(0, leaf.low, leaf.high) if leaf.supported else None)


def find_action_range(leaf: Leaf) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest numbers of an action, of the leaf's shape; [-1, 1] without bounds."""
    low, high = np.asarray(leaf.low, np.float64), np.asarray(leaf.high, np.float64)
    return np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)


def action_at(space: spaces.Space[Any], numbers: NDArray[np.float64]) -> Any:
    """Return an action whose numbers are given as fractions of their range, [-1, 1] for numbers without bounds."""
    rest = iter(numbers)

    def value_of(leaf: Leaf) -> NDArray[Any]:
        point = np.array([next(rest) for _ in range(int(np.prod(leaf.shape)))]).reshape(leaf.shape)
        low, high = find_action_range(leaf)
        if np.dtype(leaf.dtype).kind in "iub":
            return np.minimum(np.floor(low + point * (high - low + 1)), high)
        return low + point * (high - low)

    return build_action(space, value_of)


def _corner(leaf: Leaf, rng: np.random.Generator) -> NDArray[Any] | None:
    if leaf.low is None or leaf.high is None:
        return None
    corner = np.where(rng.random(leaf.shape) < 0.5, leaf.low, leaf.high)
    return np.where(np.isfinite(corner), corner, np.clip(rng.standard_normal(leaf.shape), leaf.low, leaf.high))
