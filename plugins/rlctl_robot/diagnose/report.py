"""Prints a diagnosis."""

import dataclasses
from pathlib import Path

from rlctl import output
from rlctl.storage import files, yaml_text
from rlctl_robot.diagnose.diagnose import Answers, Diagnosis
from rlctl_robot.diagnose.mapping import CorrectedMapping
from rlctl_robot.diagnose.policy_match import SAME
from rlctl_robot.diagnose.signals import ACTIONS

_ODD = 1.6  # times the usual error, from which an observation is listed
_MOST = 0.8  # of the difference, which the mistake then surely is
_FEW = 4  # odd observations that are named


def show(result: Diagnosis, json: str | None) -> None:
    """Print the answers and the findings, or write them as JSON to a file or, for `-`, to stdout."""
    mapping = result.mapping.model_dump(exclude_defaults=True)
    if output.present({**dataclasses.asdict(result), "mapping": mapping}, json):
        return
    out = output.out()
    out.print(f"{result.log}: {result.rows:,} rows, {result.seconds:.1f} s, policy {result.policy}", soft_wrap=True)
    out.print(describe_verdict(result), soft_wrap=True)
    for line in describe_answers(result):
        out.print(line, soft_wrap=True)
    main = [finding for finding in result.findings if not finding.is_weak]
    if main:
        out.print("\nfindings, the one with the most evidence first:")
    for number, finding in enumerate(main, start=1):
        out.print(f"{number}. {finding.describe()}", soft_wrap=True)
        for other in finding.also:
            out.print(f"   this log cannot tell it from: {other}", soft_wrap=True)
    weak = [finding for finding in result.findings if finding.is_weak]
    if weak:
        out.print("\ncheck again after correcting; these are not in the mapping:")
        for finding in weak:
            out.print(f"- {finding.describe()}", soft_wrap=True)
    if mapping:
        out.print("\nthe corrected mapping, corrected = sign * scale * value[order] + offset:")
        out.print(describe_mapping(result.mapping), end="", soft_wrap=True)


def describe_verdict(result: Diagnosis) -> str:
    """Return what is wrong, and how sure that is, as one line."""
    if result.answers.unexplained:
        return f"something differs, the cause is unknown: {result.answers.unexplained}"
    mistakes = [finding for finding in result.findings if finding.is_mistake and not finding.is_weak]
    if not mistakes:
        if result.findings:
            return f"something differs, the cause is unknown: {result.findings[0].text}"
        return "no mistake in the mapping found"
    first = mistakes[0]
    if first.also:
        sure = f"one of {1 + len(first.also)} causes that this log cannot tell apart"
    elif first.explains < _MOST:
        sure = f"likely, but it explains only {first.explains:.0%} of what differs"
    else:
        sure = f"sure: it explains {first.explains:.0%} of what differs, and nothing else that was tried does"
    more = f"; {len(mistakes) - 1} more below" if len(mistakes) > 1 else ""
    return f"wrong is {first.text} ({sure}{more})"


def write_mapping(result: Diagnosis, file: Path) -> None:
    """Write the corrected mapping as YAML, as `rlctl export --controller --mapping` reads it.

    Nothing is written, and a note says so, where there is nothing to correct.
    """
    text = describe_mapping(result.mapping)
    if text:
        files.write_result(file, text.encode())
        output.print_notes([f"mapping: {file}"])
    else:
        output.print_notes([f"{file}: not written: the mapping needs no correction"])


def describe_mapping(mapping: CorrectedMapping) -> str:
    """Return the mapping as YAML; of `actions` and `targets` a comment says which one a program uses."""
    content = mapping.model_dump(exclude_defaults=True)
    targets = content.pop("targets", None)
    text = yaml_text.dump(content) if content else ""
    if targets is None:
        return text
    if "actions" in content:
        text += "# the same for a program that sends targets of joints; it does not apply `actions`\n"
    return text + yaml_text.dump({"targets": targets})


def _describe_difference(answers: Answers) -> str:
    before, after = answers.policy_difference, answers.policy_difference_corrected
    if before is None or after is None:
        return "unknown: the server held the robot or limited the action in nearly all rows"
    if before < SAME and not after < before:
        return f"yes: they differ by {before:.2g} standard deviations on average"
    return f"no: they differ by {before:.2g} standard deviations on average, {after:.2g} when corrected"


def describe_answers(result: Diagnosis) -> list[str]:
    """Return a line for each of the three questions."""
    answers = result.answers
    first = f"1. does the policy produce the logged actions? {_describe_difference(answers)}"
    odd = sorted(answers.term_errors.items(), key=lambda item: -item[1][0])
    found = {finding.term for finding in result.findings if finding.question == 2}
    better = {name for name, (before, after) in odd if after < before}
    odd = [(name, errors) for name, errors in odd if errors[0] > _ODD or name in found & better]
    second = "2. are the observations those of the simulation? "
    if odd:
        named = ", ".join(f"{name} {before:.3g} -> {after:.3g}" for name, (before, after) in odd[:_FEW])
        second += f"errors in units of the usual ones, as logged and corrected: {named}"
    elif changed := _list_changed(result):
        second += f"no, though each alone looks usual: {', '.join(changed)}"
    else:
        second += "yes"
    return [first, second, f"3. does the simulation predict the next row? {_describe_step(result)}"]


def _describe_step(result: Diagnosis) -> str:
    """Return how well the next row is predicted, by the statistic that decided what is wrong."""
    (before, after), usual = result.answers.step_error, "the usual ones"
    if result.answers.simulated_error is not None:
        (before, after), usual = result.answers.simulated_error, "the largest errors of a sound robot"
    if result.findings and after < before:
        return f"better when corrected: errors are {before:.3g} times {usual} as logged, {after:.3g} times corrected"
    return f"errors are {before:.3g} times {usual}"


def _list_changed(result: Diagnosis) -> list[str]:
    """Return the observations that a mistake between robot and policy changes, where it explains the log."""
    names: dict[str, None] = {}
    for finding in result.findings:
        if finding.question == 1 or finding.is_weak or not finding.is_mistake or finding.correction is None:
            continue
        parts = finding.correction.parts or (finding.correction,)
        names.update(dict.fromkeys(part.term for part in parts if part.term != ACTIONS))
    return list(names)
