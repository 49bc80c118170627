"""`rlctl gate`: checks the environment, evaluates the policy, compares it with a stored one, and exports it."""

import dataclasses
import enum
import time
from collections.abc import Callable
from pathlib import Path

from rlctl.checking import junit as check_junit
from rlctl.checking.check import CheckReport, check
from rlctl.checking.rule_index import choose_rules
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RlctlError, UsageError
from rlctl.evaluation import junit as evaluation_junit
from rlctl.evaluation.eval_request import NO_GATES, EvalRequest, Gates
from rlctl.evaluation.evaluate import Evaluation, run_evaluation
from rlctl.evaluation.players import find_player
from rlctl.exporting.export import export_policy
from rlctl.exporting.export_request import ExportRequest, Format
from rlctl.exporting.report import ExportReport
from rlctl.runs import lookup
from rlctl.runs.compare.comparison import NOT_WORSE, ComparisonGate, RunComparison, compare
from rlctl.runs.compare.significance import Verdict
from rlctl.storage import junit
from rlctl.storage.junit import Case, Suite


@dataclasses.dataclass(frozen=True)
class GateRequest:
    """What must hold before a policy is used."""

    evaluation: EvalRequest
    gates: Gates
    against: Path | None = None
    """The policy in use, which the new one must not be worse than; None: nothing is compared."""
    comparison: ComparisonGate = NOT_WORSE  # what it must show against that one
    export: Path | None = None  # file to write, .onnx or .c; None: nothing is exported
    strict: bool = False  # whether warnings of the check fail
    budget_s: float | None = None  # of each process of the check; None: as much as `check-env` takes
    checks: bool = True  # whether the environment is checked

    def __post_init__(self) -> None:
        if self.gates == NO_GATES and self.against is None:
            raise UsageError(
                "gate: say what the policy must reach, e.g. --min-success-lower 0.9, or --min-return 100; "
                "or which policy it must not be worse than: --against FILE"
            )
        if self.comparison.margin is not None and self.against is None:
            raise UsageError("--margin: with what is it compared? Add --against FILE.safetensors")
        if self.export is not None and self.export.suffix not in (".onnx", ".c"):
            raise UsageError(f"--export {self.export}: give a name that ends in .onnx or .c")


class Result(enum.StrEnum):
    """How a step ended."""

    PASSED = "passed"
    FAILED = "failed"  # its answer is no
    ERROR = "error"  # it could not answer
    SKIPPED = "skipped"


@dataclasses.dataclass(frozen=True)
class GateStep:
    """A step of the gate."""

    name: str
    result: Result
    summary: str  # in a line: what was measured, or why not
    problems: tuple[str, ...] = ()
    exit_code: int = 0
    seconds: float = 0.0  # [s]


@dataclasses.dataclass(frozen=True)
class GateReport:
    """The steps, and what they found."""

    task: str
    policy: Path
    steps: list[GateStep]
    gates: Gates
    checked: CheckReport | None = None
    evaluation: Evaluation | None = None
    comparison: RunComparison | None = None
    exported: list[ExportReport] = dataclasses.field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """That of the first step that failed or could not answer; an error counts more than a negative answer."""
        codes = [step.exit_code for step in self.steps if step.exit_code]
        errors = [code for code in codes if code != 1]
        return next(iter(errors or codes), 0)

    def make_suites(self) -> list[Suite]:
        """Return the test cases: the rules of the check, the gates, and a case for each step.

        A step whose failure is a case of its own suite has no case here: it would be counted twice.
        """
        classname = f"{self.task}.gate"
        suites = {}
        if self.checked is not None:
            suites["check"] = check_junit.make_suite(self.checked)
        if self.evaluation is not None:
            seconds = next(step.seconds for step in self.steps if step.name == "eval")
            suites["eval"] = evaluation_junit.make_suite(self.evaluation, self.gates, seconds)
        reported = [step.name for step in self.steps if step.result is Result.FAILED and _fails(suites.get(step.name))]
        cases = [_make_case(classname, step) for step in self.steps if step.name not in reported]
        seconds = sum(step.seconds for step in self.steps if step.name not in reported)
        return [*suites.values(), Suite(f"rlctl gate {self.task}", seconds, cases)]


def _fails(suite: Suite | None) -> bool:
    """Whether a test case of the suite has not passed."""
    return suite is not None and any(
        entry.tag in ("failure", "error") for case in suite.cases for entry in case.outcomes
    )


def _make_case(classname: str, step: GateStep) -> Case:
    tags = {Result.FAILED: "failure", Result.ERROR: "error", Result.SKIPPED: "skipped", Result.PASSED: "system-out"}
    text = "\n".join([step.summary, *step.problems])
    message = "" if step.result is Result.PASSED else (step.problems or (step.summary,))[0]
    outcome = junit.CaseEntry(tags[step.result], message=message, text=text)
    return Case(classname, step.name, [outcome], seconds=step.seconds)


def run_gate(request: GateRequest, show: Callable[[object], None], *, quiet: bool = False) -> GateReport:
    """Take all steps and return their report; `show` is called with the result of each, unless `quiet`.

    A step that fails does not end the gate: the report says everything that is wrong. Only the export is left out after
    a failure, so that nothing lies ready that must not be used. Raises `ArtifactError` if there is no policy.
    """
    source, _, spec = find_player(request.evaluation, print_notes=lambda notes: None)
    if source.run is not None:  # `latest` may be another run before the gate ends
        pinned = dataclasses.replace(request.evaluation, run=str(source.run.path))
        request = dataclasses.replace(request, evaluation=pinned)
    found = _Findings(request, source, spec, (lambda result: None) if quiet else show)
    steps = []
    if request.checks:
        steps.append(found.take("check", found.check))
    else:
        steps.append(GateStep("check", Result.SKIPPED, "left out: --no-check"))
    steps.append(found.take("eval", found.play))
    if request.against is None:
        steps.append(GateStep("compare", Result.SKIPPED, "nothing to compare with: --against FILE"))
    else:
        steps.append(found.take("compare", found.compare))
    if request.export is None:
        steps.append(GateStep("export", Result.SKIPPED, "not asked for: --export FILE"))
    elif any(step.exit_code for step in steps):
        steps.append(GateStep("export", Result.SKIPPED, "nothing is written after a step that failed"))
    else:
        steps.append(found.take("export", found.export))
    return GateReport(
        task=found.spec.task,
        policy=source.file,
        steps=steps,
        gates=request.gates,
        checked=found.checked,
        evaluation=found.evaluation,
        comparison=found.comparison,
        exported=found.exported,
    )


class _Findings:
    """Takes the steps, and keeps what each found."""

    def __init__(
        self, request: GateRequest, source: lookup.FoundPolicy, spec: EnvSpec, show: Callable[[object], None]
    ) -> None:
        self._request, self._source, self._show = request, source, show
        self.spec = spec
        self.checked: CheckReport | None = None
        self.evaluation: Evaluation | None = None
        self.comparison: RunComparison | None = None
        self.exported: list[ExportReport] = []

    def take(self, name: str, step: Callable[[], tuple[str, list[str]]]) -> GateStep:
        """Return how a step ended; it returns a summary and what is wrong."""
        began = time.monotonic()
        try:
            summary, problems = step()
        except RlctlError as error:
            result = Result.FAILED if error.exit_code == 1 else Result.ERROR
            first, *more = str(error).splitlines() or [""]
            return GateStep(name, result, first, (first, *more), error.exit_code, time.monotonic() - began)
        result = Result.FAILED if problems else Result.PASSED
        return GateStep(name, result, summary, tuple(problems), int(bool(problems)), time.monotonic() - began)

    def check(self) -> tuple[str, list[str]]:
        """Check the environment, with the parameters that the policy is evaluated with."""
        request = self._request
        spec = EnvSpec(self.spec.task, dict(self.spec.parameters), sim=self.spec.sim, named_by=self.spec.named_by)
        report = check(
            spec,
            rules=choose_rules([], []),
            strict=request.strict,
            env_timeout_s=request.evaluation.env_timeout_s,
            budget_s=request.budget_s,
        )
        self.checked = report
        self._show(report)
        problems = []
        if report.exit_code:
            problems = [
                f"{finding.rule} {finding.message.partition(chr(10))[0]}" for finding in report.verdict.findings
            ]
            if report.fails_for_time or not problems:
                problems.insert(0, report.summarize())
        return report.summarize(), problems

    def play(self) -> tuple[str, list[str]]:
        """Evaluate the policy and judge the gates."""
        self.evaluation = result = run_evaluation(self._request.evaluation, self._request.gates)
        self._show(result)
        scores = result.success_rate, result.success_interval, result.returns.mean
        summary = f"return {result.returns.mean:.4g} in {len(result.played)} episodes"
        if result.success_rate is not None and result.success_interval is not None:
            low, high = result.success_interval
            summary = f"success {result.success_rate:.1%} ({low:.1%} to {high:.1%}), {summary}"
        return summary, self._request.gates.list_missed(*scores)

    def compare(self) -> tuple[str, list[str]]:
        """Compare the policy with the stored one, in the same episodes."""
        request, options = self._request, self._request.evaluation
        others = EvalRequest(
            None, task=options.task, episodes=options.episodes, seed=options.seed, changes=options.changes
        )
        texts = [str(request.against), str(self._source.file)]
        self.comparison = result = compare(texts, others, margin=request.comparison.margin)
        self._show(result)
        missed = list(result.find_missed(request.comparison).values())
        verdict = result.candidates[0].verdict
        summary = f"{verdict} than {request.against}"
        if verdict is Verdict.CANNOT_TELL:
            summary = f"no difference shown from {request.against}"
        return summary, missed

    def export(self) -> tuple[str, list[str]]:
        """Write the policy for the robot, and verify that it acts the same."""
        target = self._request.export
        assert target is not None
        form: Format = "c" if target.suffix == ".c" else "onnx"
        options = self._request.evaluation
        request = ExportRequest(options.run, (form,), options.checkpoint, target, sim=options.changes.sim)
        reports = export_policy(request)
        self.exported = reports
        self._show(reports)
        for report in reports:
            report.check()
        return f"{target}, verified", []
