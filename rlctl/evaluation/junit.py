"""Evaluations as JUnit XML: a gate is a test case, of a group for each seed, of a robustness map of the worst cell."""

from rlctl.evaluation.eval_request import Gates, Scores
from rlctl.evaluation.evaluate import Evaluation
from rlctl.evaluation.group_scores import GroupScore
from rlctl.evaluation.robustness import Robustness
from rlctl.storage.junit import Case, CaseEntry, Suite, make_gate_case


def make_suite(result: Evaluation, gates: Gates, seconds: float) -> Suite:
    """Return the test cases of an evaluation that took so long [s]."""
    scores = result.success_rate, result.success_interval, result.returns.mean
    return Suite(f"rlctl eval {result.spec.task}", seconds, make_cases(f"{result.spec.task}.eval", "", gates, scores))


def make_group_suite(result: GroupScore, gates: Gates, seconds: float) -> Suite:
    """Return the test cases of every seed of a group; a seed without a score is an error."""
    task = result.group.task
    cases: list[Case] = []
    for seed in result.seeds:
        name = f"seed {seed.seed}"
        if seed.score is None:
            cases.append(Case(f"{task}.eval", name, [CaseEntry("error", message=seed.problem)]))
            continue
        scores = seed.score.success, seed.score.success_interval, seed.score.mean_return
        cases += make_cases(f"{task}.eval", name, gates, scores)
    return Suite(f"rlctl eval {task}", seconds, cases)


def make_robustness_suite(result: Robustness, gates: Gates, seconds: float) -> Suite:
    """Return the test cases of the worst cell, which the gates judge."""
    where, outcome = result.name_worst()
    scores = outcome.success_rate, outcome.success_interval, outcome.mean_return
    cases = make_cases(f"{result.task}.eval", f"worst cell, {where}", gates, scores)
    return Suite(f"rlctl eval {result.task}", seconds, cases)


def make_cases(classname: str, what: str, gates: Gates, scores: Scores) -> list[Case]:
    """Return a case for each gate, or without gates one that passes; `what` was evaluated."""
    rate, _, mean_return = scores
    measured = f"mean return {mean_return:.4g}"
    if rate is not None:
        measured = f"success rate {rate:.1%}, {measured}"
    missed = gates.find_missed(*scores)
    given = gates.list_given()
    if not given:
        return [make_gate_case(classname, what or "evaluation", [], measured)]
    prefix = f"{what}: " if what else ""
    cases = []
    for name, gate in given.items():
        problems = [missed[name]] if name in missed else []
        cases.append(make_gate_case(classname, f"{prefix}{gate}", problems, measured))
    return cases
