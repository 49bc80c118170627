"""RL2: the interface: what reset and step take and return, and that they come back at all."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rlctl.check_env import studies
from rlctl.check_env.evidence import RAISED, Evidence, Failure, Form, Trajectory
from rlctl.check_env.finding import NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import Attributes
from rlctl.check_env.rules.known import built, lived, lost_display, result

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

BOOL = "bool"
NUMBERS = ("float", "int", "numpy.float64")
"""Reward types that both libraries accept."""
MANY_LINES = 0.1
"""Lines printed per step from which printing is slow."""
MOST_FAILURES = 3
NOT_ALONE = ("interleaved", "after close", *studies.PROVOKING)
"""Where a failure is another rule's matter."""


def first_form(evidence: Evidence, what: str, *fine: str) -> Iterator[tuple[Trajectory, Form]]:
    """Yield the first place of each type of something, those that are fine left out."""
    seen = set()
    for trajectory in lived(evidence):
        for form in trajectory.forms:
            if form.what == what and form.type not in fine and form.type not in seen:
                seen.add(form.type)
                yield trajectory, form


def _place(trajectory: Trajectory, form: Form, expected: str) -> dict[str, Any]:
    return {**trajectory.place, "step": form.step, "type": form.type, "expected": expected}


@rule(
    "RL201",
    "return values",
    ERROR,
    "reset returns (observation, info); step returns (observation, reward, terminated, truncated, info).",
    complaints=(
        r"not a tuple of the form",
        r"2-tuple",
        r"step result to be a tuple",
        r"four or five element",
        r"old step API",
        r"values to unpack",
        r"must return (a tuple|five values)",
    ),
)
def return_values(evidence: Evidence) -> Iterator[Seen]:
    """reset or step returns another number of values than Gymnasium's interface has. Four values from step are the
    old `gym`: its single `done` cannot tell a failure from a time limit."""
    for trajectory, form in first_form(evidence, "reset"):
        yield Seen(f"reset returns {form.type}", _place(trajectory, form, "tuple of 2"))
    for trajectory, form in first_form(evidence, "step"):
        yield Seen(f"step returns a {form.type}", _place(trajectory, form, "tuple of 5"))


@rule(
    "RL202",
    "reset takes no seed",
    ERROR,
    "def reset(self, *, seed=None, options=None): super().reset(seed=seed) ...",
    complaints=(
        r"provide a `seed`",
        r"passed a `seed`",
        r"must accept a `seed`",
        r"reset with a random seed",
        r"argument 'seed'",
    ),
)
def takes_seed(evidence: Evidence) -> Iterator[Seen]:
    """reset has no `seed`, so no episode can be repeated, and every library that seeds fails at its first call."""
    if not built(evidence).accepts_seed:
        yield Seen("reset has no parameter `seed`")


@rule(
    "RL203",
    "reset takes no options",
    WARNING,
    "def reset(self, *, seed=None, options=None): ...",
    complaints=(r"provide an `options`", r"passed `options`", r"reset with options"),
    only_complaints=True,
)
def takes_options(evidence: Evidence) -> Iterator[Seen]:
    """reset has no `options`; Gymnasium's wrappers pass it and fail."""
    return iter(())


@rule(
    "RL204",
    "terminated or truncated is no bool",
    ERROR,
    "bool(...) around both: a comparison of numpy numbers gives numpy.bool.",
    complaints=(r"signal (to|must) be a boolean", r"Expects `done` signal", r"truth value of an array"),
)
def flag_types(evidence: Evidence) -> Iterator[Seen]:
    """A flag is not Python's bool. Gymnasium accepts numpy.bool, Stable-Baselines3's checker refuses it, and
    `terminated is True` is false for it."""
    for what in ("terminated", "truncated"):
        for trajectory, form in first_form(evidence, what, BOOL):
            yield Seen(f"{what} is {_a(form.type)} at step {form.step}", _place(trajectory, form, BOOL))


@rule(
    "RL205",
    "reward is no number",
    ERROR,
    "Return float(reward).",
    complaints=(r"reward returned by `step\(\)` must be",),
)
def reward_type(evidence: Evidence) -> Iterator[Seen]:
    """The reward is not a float. An array or None fails or broadcasts; a numpy number of another kind trains, but
    Stable-Baselines3's checker refuses it, so it is a warning."""
    for trajectory, form in first_form(evidence, "reward", *NUMBERS):
        scalar = form.type.startswith(("numpy.float", "numpy.int", "numpy.uint"))
        message = f"the reward is {_a(form.type)} at step {form.step}"
        yield Seen(message, _place(trajectory, form, "float"), WARNING if scalar else None)


@rule(
    "RL206",
    "info is no dict",
    ERROR,
    "Return a dict, empty if there is nothing to say.",
    complaints=(r"info.* must be a (python )?dictionary", r"second element .*dictionary"),
)
def info_type(evidence: Evidence) -> Iterator[Seen]:
    """Wrappers write into info; what is no dict fails there."""
    for trajectory, form in first_form(evidence, "info", "dict"):
        yield Seen(f"info is {_a(form.type)} at step {form.step}", _place(trajectory, form, "dict"))


def _a(type_name: str) -> str:
    return type_name if type_name == "NoneType" else f"a {type_name}"


def calls_alone(evidence: Evidence, kind: str) -> Iterator[Failure]:
    """Yield the calls of one kind that failed on an instance that was alone, each error once."""
    seen: set[tuple[str, str]] = set()
    for failure in evidence.failures:
        if failure.kind != kind or failure.call in ("load", "build") or failure.phase in NOT_ALONE:
            continue
        if failure.process == "checkers" and seen:
            continue
        if (failure.call, failure.error) not in seen:
            seen.add((failure.call, failure.error))
            yield failure


def where(failure: Failure) -> dict[str, Any]:
    """Return a failure's place, as evidence."""
    place: dict[str, Any] = {"call": failure.call, "seed": failure.seed, "episode": failure.episode}
    place["step"] = failure.step
    if failure.details:
        place["traceback" if failure.kind == "raised" else "last_output"] = failure.details
    return place


def _in_call(failure: Failure) -> str:
    return f"step {failure.step}" if failure.call == "step" else failure.call


@rule(
    "RL207",
    "raises",
    ERROR,
    "Live the episode again with this seed and these actions, and repair what raises.",
    complaints=(f"^{RAISED}",),
)
def raises(evidence: Evidence) -> Iterator[Seen]:
    """A call into the environment raises with actions from its own action space. Training ends there."""
    raised = (failure for failure in calls_alone(evidence, "raised") if failure.file is None)  # RL007 has those
    for count, failure in enumerate(raised):
        if count == MOST_FAILURES:
            break
        yield Seen(f"{_in_call(failure)} raised {failure.error}", where(failure))


@rule(
    "RL208",
    "ends the process",
    ERROR,
    "Run the episode under `python -X faulthandler`; a library is used after close, or with an id that it does not "
    "know. os._exit belongs in no environment.",
)
def survives(evidence: Evidence) -> Iterator[Seen]:
    """A call into the environment crashes or ends the interpreter. In training it takes the worker with it."""
    built(evidence)
    for failure in calls_alone(evidence, "died"):
        if lost_display(failure):
            continue  # RL216 says why
        yield Seen(f"the process {failure.error} in {_in_call(failure)}", where(failure))


@rule(
    "RL209",
    "hangs",
    ERROR,
    "Find what it waits for (input, a window, a lock, a connection); if it is only slow, raise --env-timeout.",
)
def comes_back(evidence: Evidence) -> Iterator[Seen]:
    """A call into the environment does not come back."""
    built(evidence)
    for failure in calls_alone(evidence, "hung"):
        yield Seen(f"{_in_call(failure)} {failure.error}", where(failure))
        break


@rule(
    "RL210",
    "reset does not call super().reset(seed=seed)",
    WARNING,
    "Call super().reset(seed=seed) first, and draw all chance from self.np_random.",
    complaints=(r"does not call `super\(\)\.reset", r"random number generators? (to have been|are not different)"),
    only_complaints=True,
)
def seeds_generator(evidence: Evidence) -> Iterator[Seen]:
    """self.np_random is not seeded. Whatever draws from it, wrappers and base classes included, cannot be repeated;
    whether the episodes can is judged by RL301 to RL306."""
    return iter(())


@rule("RL211", "prints", INFO, "Use the logging module, or say it in info.")
def silent(evidence: Evidence) -> Iterator[Seen]:
    """It writes to standard output. With many environments that hides everything else, and a line per step is
    slow."""
    lines = evidence.printed_lines
    if not lines:
        return
    steps = max(1, sum(each.steps for each in evidence.trajectories))
    first = evidence.printed_first[:80]
    severity = WARNING if lines > MANY_LINES * steps and lines > 20 else None
    yield Seen(
        f"{lines} lines on stdout in {steps} steps, the first: {first!r}", {"value": lines, "expected": 0}, severity
    )


@rule(
    "RL214",
    "attributes that wrappers need",
    WARNING,
    "Leave np_random, metadata, render_mode and unwrapped as gymnasium.Env has them, and make each space once, in the "
    "constructor.",
    needs=("attributes",),
    complaints=(r"no attribute 'bit_generator'", r"'(list|tuple|str|NoneType)' object has no attribute 'get'"),
)
def attributes(evidence: Evidence) -> Iterator[Seen]:
    """An attribute that every gymnasium.Env has is missing, or is something else: wrappers that read it fail, or see
    something that changes under them. Old code puts a RandomState into np_random."""
    if not built(evidence).is_env:
        raise NotJudged("it is no gymnasium.Env (RL003)")
    for problem in result(evidence, Attributes, "attributes").problems:
        yield Seen(problem, {"value": problem})
