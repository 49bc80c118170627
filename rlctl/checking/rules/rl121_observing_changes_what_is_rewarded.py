"""RL121: observing changes what is rewarded."""

import contextlib
import functools
import inspect
import random
import sys
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.action_trials import REWARD, Frame, Trials
from rlctl.checking.episode import EpisodePlayer, Moment
from rlctl.checking.experiments.action_effects import ActionTrials, judges_actions
from rlctl.checking.instance import Instance
from rlctl.checking.records import FIRST_SEED, SECOND_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.values import (
    find_assignment,
    find_author,
    find_unequal,
    flatten,
    is_task,
    read_attributes,
    shape_like,
)

RULE = Rule(
    "RL121",
    "observing changes what is rewarded",
    Severity.WARNING,
    meaning="""
        The method that observes changes an attribute that reset draws and the reward uses, most often the goal:
        noise or an offset is added to the attribute itself instead of to a copy. The check called the method twice
        more after a reset, and gave the same random numbers to what follows: the rewards of the episode were others.
        So the goal drifts away while the episode lasts, and whoever looks at an observation changes the task.
    """,
    fix="Add noise to a copy: goal = self.goal + noise, not self.goal += noise, nor += on an array that is self.goal.",
)

STEPS = 15  # of the compared episodes
SAME = 1e-6  # relative
MOST_LOOKS = 2  # of a reset
FAR = 3.0  # times the change by a look: how far apart are the values that resets draw
SHOWN = 4  # numbers of an attribute
VARIABLE_ARGUMENTS = inspect.CO_VARARGS | inspect.CO_VARKEYWORDS
Numbers = NDArray[np.float64]


@judges_actions(RULE, place=10)
def _look_twice(shown: ActionTrials) -> Iterator[RuleFinding]:
    """Call the method that observes twice more after a reset, and compare the rewards that follow."""
    trials, instance = shown.trials, shown.trials.instance
    observe = _find_observe(instance)
    if observe is None:
        return
    plain = trials.plain(FIRST_SEED, STEPS)
    look = _Look(instance, observe)
    looked = trials.play(FIRST_SEED, trials.actions(FIRST_SEED, STEPS), look)
    step = _find_other_reward(plain, looked)
    if step is None:
        return
    other = _Look(instance, observe)
    trials.play(SECOND_SEED, [], other)
    for name in find_unequal(look.first, look.last):
        is_sensor = look.is_clock(name) or not _is_drawn(look, other, name) or not _accumulates(trials, look, name)
        if not is_sensor and _decides(trials, look, name):
            before, after = (_list_numbers(values[name].numbers) for values in (look.first, look.last))
            value, expected = float(looked[step][REWARD]), float(plain[step][REWARD])
            twice = f"{observe.__name__}() changes {name}: called twice more after the reset, {before} becomes {after}"
            message = f"{twice}, and the reward of step {step} is {value:.4g} instead of {expected:.4g}"
            evidence = {"element": name, "seed": FIRST_SEED, "step": step, "value": value, "expected": expected}
            yield RuleFinding(RULE, message, evidence, where=find_assignment(instance.env, name))
            return


def _find_observe(instance: Instance) -> Callable[[], Any] | None:
    """Return the method of a task that observes; otherwise the one without arguments that returns in reset and in step
    what they return, if there is one."""
    author = find_author(instance.env)
    if is_task(instance.env):
        return author.observe
    episode = EpisodePlayer(instance, FIRST_SEED, max_steps=1)
    names = [_find_returned(author, call) for call in (episode.reset, episode.step)]
    if len(set(names)) > 1 or not names[0]:
        return None
    return getattr(author, names[0], None)


def _find_returned(author: Any, call: Callable[[], Moment]) -> str:
    """Return the name of the last method of the author's object, without arguments, that returns the same numbers as a
    call of reset or step; empty if there is none."""
    returned: list[tuple[str, NDArray[np.float32]]] = []

    def watch(frame: FrameType, event: str, value: Any) -> None:
        code = frame.f_code
        has_one = code.co_argcount == 1 and not code.co_kwonlyargcount and not code.co_flags & VARIABLE_ARGUMENTS
        if event == "return" and has_one and frame.f_locals.get(code.co_varnames[0]) is author:
            returned.append((code.co_name, flatten(value).astype(np.float32)))

    earlier = sys.getprofile()
    sys.setprofile(watch)
    try:
        moment = call()
    finally:
        sys.setprofile(earlier)
    observed = flatten(moment.observation).astype(np.float32)  # a method may return other floats than reset and step
    names = [name for name, numbers in returned if numbers.size and np.array_equal(numbers, observed, equal_nan=True)]
    return names[-1] if names else ""


def _find_other_reward(plain: Sequence[Frame], looked: Sequence[Frame]) -> int | None:
    """Return the first step with another reward."""
    least = SAME * max(float(np.abs(frame[REWARD])) for frame in plain)
    pairs = enumerate(zip(plain, looked, strict=False))
    return next((step for step, (one, two) in pairs if abs(one[REWARD] - two[REWARD]) > least), None)


class _Look:
    """Calls the method that observes twice, and sets random generators back: to be called after a reset."""

    def __init__(self, instance: Instance, observe: Callable[[], Any]) -> None:
        self._instance, self._observe = instance, observe

    def __call__(self) -> None:
        self.first = read_attributes(self._instance.env)
        with _keep_generators([attribute.value for attribute in self.first.values()]):
            self._instance.call("step", self._observe)
            self.second = read_attributes(self._instance.env)
            self._instance.call("step", self._observe)
            self.last = read_attributes(self._instance.env)

    def and_restore(self, name: str) -> None:
        """Look, and set an attribute back."""
        self()
        self.first[name].assign(self.first[name].value)

    def at(self, name: str, value: Any) -> None:
        """Look after an attribute was set to a value."""
        read_attributes(self._instance.env)[name].assign(value)
        self()

    def again(self) -> "_Look":
        """Return another look."""
        return _Look(self._instance, self._observe)

    def is_clock(self, name: str) -> bool:
        """Say whether all numbers of an attribute advance by the same, as counters and phases do."""
        first, second, last = (values[name].numbers for values in (self.first, self.second, self.last))
        changes = np.concatenate([second - first, last - second])
        return bool(np.ptp(changes) <= SAME * np.abs(changes).max())


def _is_drawn(look: _Look, other: _Look, name: str) -> bool:
    """Say whether reset draws an attribute: not one that begins at 0, such as the integral of an error or the drift of
    a sensor, and differs because reset observes once."""
    if name not in find_unequal(look.first, other.first):
        return False
    first, second, last = (values[name].numbers for values in (look.first, look.second, look.last))
    change, size = second - first, float(np.abs(first).max())
    if np.abs(last - second - change).max() <= SAME * size:
        return all(np.abs(first - times * change).max() > SAME * size for times in range(MOST_LOOKS + 1))
    return bool(np.abs(first - other.first[name].numbers).max() > FAR * np.abs(change).max())


def _decides(trials: Trials, look: _Look, name: str) -> bool:
    """Say whether all rewards are as without a look if only this attribute is set back after it."""
    restore = functools.partial(look.again().and_restore, name)
    restored = trials.play(FIRST_SEED, trials.actions(FIRST_SEED, STEPS), restore)
    return _find_other_reward(trials.plain(FIRST_SEED, STEPS), restored) is None


def _accumulates(trials: Trials, look: _Look, name: str) -> bool:
    """Say whether looks add to the attribute, or scale it: what is computed again in each, or fades, is a memory of the
    sensor."""
    first, last = look.first[name], look.last[name].numbers
    shift = 0.1 + 0.1 * np.abs(first.numbers).max()
    for numbers, expected in ((first.numbers + shift, last + shift), (2 * first.numbers, 2 * last)):
        again = look.again()
        trials.play(FIRST_SEED, [], functools.partial(again.at, name, shape_like(first.value, numbers)))
        if np.abs(again.last[name].numbers - expected).max() <= SAME * np.abs(expected).max():
            return True
    return False


@contextlib.contextmanager
def _keep_generators(values: Sequence[Any]) -> Iterator[None]:
    """Give random generators, and those of the process, the state back that they have now."""
    states: list[tuple[Callable[[Any], None], Any]] = []
    for value in (*values, np.random.mtrand._rand, random._inst):
        if isinstance(value, np.random.Generator):
            states.append((functools.partial(setattr, value.bit_generator, "state"), value.bit_generator.state))
        elif isinstance(value, np.random.RandomState):
            states.append((value.set_state, value.get_state()))
        elif isinstance(value, random.Random):
            states.append((value.setstate, value.getstate()))
    try:
        yield
    finally:
        for restore, state in states:
            restore(state)


def _list_numbers(numbers: Numbers) -> str:
    texts = [f"{number:.4g}" for number in numbers[:SHOWN].tolist()]
    more = ["..."] if numbers.size > SHOWN else []
    return texts[0] if numbers.size == 1 else f"[{', '.join([*texts, *more])}]"
