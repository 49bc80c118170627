"""RL2: the interface: what reset and step take and return, and that they come back."""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.experiment import RECORDING, check
from rlctl.check_env.failures import lacks_display
from rlctl.check_env.finding import Finding, Severity
from rlctl.check_env.messages import Failure, Form, Trajectory
from rlctl.check_env.records import Records

NUMBERS = ("float", "int", "numpy.float64")
"""Reward types that both libraries accept."""
MANY_LINES = 0.1
"""Lines printed per step from which printing is slow."""
FEWEST_STEPS = 20
"""With fewer, what is printed belongs to the start."""
MOST_FAILURES = 3
RENDERING = "rendering"
"""The experiment that renders."""
OF_OTHER_RULES = ("interleaved", "after close", RENDERING)
"""Where a failure is the matter of RL401, RL402 and RL215."""


@check("RL201")
def _find_other_number_of_values(records: Records) -> Iterator[Finding]:
    for trajectory, form in _first_forms(records, "reset"):
        yield _of_form("RL201", f"reset returns {form.type}", trajectory, form, "tuple of 2")
    for trajectory, form in _first_forms(records, "step"):
        yield _of_form("RL201", f"step returns a {form.type}", trajectory, form, "tuple of 5")


@check("RL202", "build")
def _find_reset_without_seed(records: Records) -> Iterator[Finding]:
    if not records.require_built().accepts_seed:
        yield Finding("RL202", "reset has no parameter `seed`")


@check("RL203", "build")
def _find_reset_without_options(records: Records) -> Iterator[Finding]:
    built = records.require_built()
    if built.accepts_seed and not built.accepts_options:  # without `seed`, RL202 says what reset has to look like
        yield Finding("RL203", "reset has no parameter `options`")


@check("RL204")
def _find_wrong_types(records: Records) -> Iterator[Finding]:
    for what in ("terminated", "truncated"):
        for trajectory, form in _first_forms(records, what, "bool"):
            message = f"{what} is {_a(form.type)} at step {form.step}"
            severity = Severity.INFO if form.type in ("numpy.bool", "numpy.bool_") else None
            yield _of_form("RL204", message, trajectory, form, "bool", severity)
    for trajectory, form in _first_forms(records, "reward", *NUMBERS):
        is_number = form.type.startswith(("numpy.float", "numpy.int", "numpy.uint"))
        message = f"the reward is {_a(form.type)} at step {form.step}"
        yield _of_form("RL204", message, trajectory, form, "float", Severity.INFO if is_number else None)
    for trajectory, form in _first_forms(records, "info", "dict"):
        yield _of_form("RL204", f"info is {_a(form.type)} at step {form.step}", trajectory, form, "dict")


def _first_forms(records: Records, what: str, *fine: str) -> Iterator[tuple[Trajectory, Form]]:
    """Yield the first place of each type of something, without those that are fine."""
    types = set(fine)
    for trajectory, form in records.forms(what):
        if form.type not in types:
            types.add(form.type)
            yield trajectory, form


def _of_form(
    rule: str, message: str, trajectory: Trajectory, form: Form, expected: str, severity: Severity | None = None
) -> Finding:
    return Finding(rule, message, trajectory.at(form.step, type=form.type, expected=expected), severity)


def _a(type_name: str) -> str:
    return type_name if type_name == "NoneType" else f"a {type_name}"


def select_failures(records: Records, kind: str) -> Iterator[Failure]:
    """Yield the calls that raised, died or hung on an instance that was alone and used properly, each error once."""
    errors: set[tuple[str, str]] = set()
    for failure in records.failures:
        if failure.kind != kind or failure.call in ("load", "build") or failure.phase in OF_OTHER_RULES:
            continue
        if (failure.call, failure.error) not in errors:
            errors.add((failure.call, failure.error))
            yield failure


@check("RL207")
def _find_exceptions(records: Records) -> Iterator[Finding]:
    raised = [each for each in select_failures(records, "raised") if each.file is None]  # the others are RL007's
    for failure in raised[:MOST_FAILURES]:
        yield Finding("RL207", failure.message, failure.place)


@check("RL208")
def _find_ends_of_process(records: Records) -> Iterator[Finding]:
    for failure in select_failures(records, "died"):
        if not lacks_display(failure):  # RL216 says why
            yield Finding("RL208", failure.message, failure.place)


@check("RL209")
def _find_hangs(records: Records) -> Iterator[Finding]:
    for failure in list(select_failures(records, "hung"))[:1]:
        yield Finding("RL209", failure.message, failure.place)


@check("RL211", *RECORDING)
def _find_prints(records: Records) -> Iterator[Finding]:
    lines = records.printed_lines
    if lines:
        steps = max(1, sum(each.steps for each in records.trajectories))
        message = f"{lines} lines on stdout in {steps} steps, the first: {records.printed_first[:80]!r}"
        severity = Severity.WARNING if steps >= FEWEST_STEPS and lines > max(20, MANY_LINES * steps) else None
        yield Finding("RL211", message, {"value": lines, "expected": 0}, severity)
