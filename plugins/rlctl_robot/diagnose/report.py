"""Prints a diagnosis."""

import dataclasses

from rlctl import output
from rlctl.storage import yaml_text
from rlctl_robot.diagnose.diagnose import Answers, Diagnosis
from rlctl_robot.diagnose.mapping import CorrectedMapping
from rlctl_robot.diagnose.policy_match import SAME

_ODD = 1.6  # times the usual error, from which an observation is listed
_FEW = 4  # odd observations that are named


def show(result: Diagnosis, json: str | None) -> None:
    """Print the answers and the findings, or write them as JSON to a file or, for `-`, to stdout."""
    mapping = result.mapping.model_dump(exclude_defaults=True)
    if output.present({**dataclasses.asdict(result), "mapping": mapping}, json):
        return
    out = output.out()
    out.print(f"{result.log}: {result.rows:,} rows, {result.seconds:.1f} s, policy {result.policy}", soft_wrap=True)
    for line in describe_answers(result):
        out.print(line, soft_wrap=True)
    unexplained = result.answers.unexplained
    if unexplained:
        out.print(f"something differs, the cause is unknown: {unexplained}", soft_wrap=True)
    elif not result.findings:
        out.print("no mistake in the mapping found")
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
    else:
        second += "yes"
    return [first, second, f"3. does the simulation predict the next row? {_describe_step(result)}"]


def _describe_step(result: Diagnosis) -> str:
    """Return how well the next row is predicted, by the statistic that decided what is wrong."""
    (before, after), usual = result.answers.step_error, "the usual ones"
    if result.answers.simulated_error is not None:
        (before, after), usual = result.answers.simulated_error, "those of the worst sound robot, row by row"
    text = f"errors are {before:.3g} times {usual}"
    if result.findings and after < before:
        text += f", {after:.3g} times when corrected"
    return text
