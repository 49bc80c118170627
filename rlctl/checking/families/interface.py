"""RL2, the interface: what reset, step and render take and return, that they come back, and unasked windows."""

import itertools
from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.instance import display_error
from rlctl.checking.records import CallFailure, CheckedEpisode, Form, Records
from rlctl.checking.rule import RuleFinding, Severity
from rlctl.environments.graphics import opengl_fix
from rlctl.environments.success import SUCCESS

NUMBERS = ("float", "int", "numpy.float64")  # Reward types that both libraries accept
MANY_LINES, FEWEST_STEPS = 0.5, 20  # lines per step; with fewer steps most lines come from the start
OF_OTHER_RULES = ("interleaved", "after close", "rendering", "nan action")
"""Failures there are those of RL401, RL402, RL215 and RL704."""


@judges_records("RL201")
def _find_other_number_of_values(records: Records) -> Iterator[RuleFinding]:
    for what, expected in (("reset", "tuple of 2"), ("step", "tuple of 5")):
        for trajectory, form in _first_forms(records, what):
            yield _of_form("RL201", f"{what} returns {_a(form.type)}", trajectory, form, expected)


@judges_records("RL202", "build")
def _find_reset_without_seed(records: Records) -> Iterator[RuleFinding]:
    if not records.require_built().accepts_seed:
        yield RuleFinding("RL202", "reset has no parameter `seed`")


@judges_records("RL203", "build")
def _find_reset_without_options(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    if built.accepts_seed and not built.accepts_options:  # without `seed`, RL202 says what reset has to look like
        yield RuleFinding("RL203", "reset has no parameter `options`")


@judges_records("RL204")
def _find_wrong_types(records: Records) -> Iterator[RuleFinding]:
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
    for trajectory in records.require_alone():
        if (success := trajectory.infos.get(SUCCESS)) and not np.isin(success.values, (0, 1)).all():
            at = int(np.isin(success.values, (0, 1)).argmin())
            value, step = float(success.values[at]), int(success.steps[at])
            evidence = trajectory.at(step, element=SUCCESS, value=value, expected="true or false")
            fix = f"Report bool(...) as info['{SUCCESS}']."
            yield RuleFinding("RL204", f"{SUCCESS} is {value:.4g} at step {step}", evidence, Severity.WARNING, fix)
            return


def _first_forms(records: Records, what: str, *fine: str) -> Iterator[tuple[CheckedEpisode, Form]]:
    types = set(fine)
    for trajectory, form in records.forms(what):
        if form.type not in types:
            types.add(form.type)
            yield trajectory, form


def _of_form(
    rule: str, message: str, trajectory: CheckedEpisode, form: Form, expected: str, severity: Severity | None = None
) -> RuleFinding:
    call = "step" if form.step else "reset"
    return RuleFinding(rule, message, trajectory.at(form.step, call=call, type=form.type, expected=expected), severity)


def _a(type_name: str) -> str:
    article = "an" if type_name[0] in "aeiou" else "a"
    return type_name if type_name == "NoneType" else f"{article} {type_name}"


def select_failures(records: Records, kind: str) -> Iterator[CallFailure]:
    """Yield the calls that raised, died or hung on an instance that was alone and used properly, each error once."""
    errors: set[tuple[str, str]] = set()
    for failure in records.failures:
        if failure.kind != kind or failure.call in ("load", "build") or failure.phase in OF_OTHER_RULES:
            continue
        if (failure.call, failure.error) not in errors:
            errors.add((failure.call, failure.error))
            yield failure


@judges_records("RL207")
def _find_exceptions(records: Records) -> Iterator[RuleFinding]:
    raised = (failure for failure in select_failures(records, "raised") if failure.file is None)  # the others: RL007
    for failure in itertools.islice(raised, 3):
        yield RuleFinding("RL207", failure.message, failure.place, fix=failure.fix, where=failure.where)


@judges_records("RL208")
def _find_ends_of_process(records: Records) -> Iterator[RuleFinding]:
    without_opengl = any(opengl_fix(failure.error) for failure in select_failures(records, "raised"))
    # Of a process that ends at once, the last line that says so may be lost: another process has it.
    without_display = {(failure.call, failure.error) for failure in records.failures if display_error(failure)}
    for failure in select_failures(records, "died"):
        if (failure.call, failure.error) not in without_display and not without_opengl:  # RL216 or RL207 says why
            yield RuleFinding("RL208", failure.message, failure.place)


@judges_records("RL209")
def _find_hangs(records: Records) -> Iterator[RuleFinding]:
    for failure in itertools.islice(select_failures(records, "hung"), 1):
        yield RuleFinding("RL209", failure.message, failure.place)


@judges_records("RL211", *RECORDING)
def _find_prints(records: Records) -> Iterator[RuleFinding]:
    if lines := records.printed_lines:
        steps = max(1, sum(trajectory.steps for trajectory in records.trajectories))
        message = f"{lines} lines on stdout in {steps} steps, the first: {records.printed_first[:80]!r}"
        severity = Severity.WARNING if steps >= FEWEST_STEPS and lines > max(20, MANY_LINES * steps) else None
        yield RuleFinding("RL211", message, {"value": lines, "expected": 0}, severity)


@judges_records("RL216", *RECORDING)
def _find_lost_display(records: Records) -> Iterator[RuleFinding]:
    for failure in records.failures:
        if line := display_error(failure):
            yield RuleFinding("RL216", f"{failure.message}, because there is no display: {line!r}", failure.place)
            return
    records.require_built()
