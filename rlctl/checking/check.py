"""`check`: from a description of an environment to a report. The environment runs in child processes only."""

import contextlib
import dataclasses
import math
import time
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

from rlctl import output
from rlctl.checking.children import Supervisor
from rlctl.checking.experiments.expressions import BY_EXPRESSIONS
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding, Severity
from rlctl.checking.rule_index import (
    DECIDED_BY,
    JUDGES,
    MOST_GROWTH,
    PROCESS_S,
    PROCESSES,
    RULES,
    find_needs,
)
from rlctl.checking.working_copy import find_outdated, find_root, prefer_working_copy
from rlctl.environments import registry
from rlctl.environments.leaves import name_leaf
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError, did_you_mean

METHODS = {"RL1": "step", "RL3": "reset", "RL4": "__init__", "RL5": "step", "RL6": "step", "RL7": "step"}
"""The method that the findings of a family are about, where nothing more is known."""
BUDGET_STEP_S = 10
MOST_UNJUDGED = 0.25
"""Part of the rules that may lack time in a check that passes."""


@dataclasses.dataclass
class CheckVerdict:
    """What the rules say."""

    findings: list[RuleFinding] = dataclasses.field(default_factory=list)
    waived: list[RuleFinding] = dataclasses.field(default_factory=list)  # rlctl_ignore of the class
    judged: list[str] = dataclasses.field(default_factory=list)
    not_judged: dict[str, str] = dataclasses.field(default_factory=dict)  # rule or part of the environment -> reason
    not_applicable: dict[str, str] = dataclasses.field(default_factory=dict)  # rule -> reason
    known: list[RuleFinding] = dataclasses.field(default_factory=list)  # also in the baseline
    resolved: list[str] = dataclasses.field(default_factory=list)  # rule and element, in the baseline but not found
    crashed: dict[str, str] = dataclasses.field(default_factory=dict)  # rule or experiment -> traceback


@dataclasses.dataclass(frozen=True)
class CheckReport:
    """The verdict on one environment, and the records that it follows from."""

    task: str
    verdict: CheckVerdict
    records: Records
    seconds: float  # How long the check took
    budget_s: float  # How long the experiments of one process might take
    strict: bool = False  # Whether warnings count as errors

    @property
    def out_of_time(self) -> list[str]:
        """Rules that were not judged because the time of an experiment ended."""
        cut = {name for name, end in self.records.finished.items() if end.is_cut}
        return [rule for rule in self.verdict.not_judged if rule in RULES and find_needs([rule]) & cut]

    @property
    def is_incomplete(self) -> bool:
        """Whether so many rules were not judged for lack of time that the check is no pass, whatever it found."""
        late = len(self.out_of_time)
        return late > 0 and late >= MOST_UNJUDGED * (late + len(self.verdict.judged))

    @property
    def needed_budget(self) -> int:
        """The `--budget` that should be enough for the rules that were not judged for lack of time [s]."""
        ends = self.records.finished.values()
        needed_s = max([2 * self.budget_s, *(end.needed_s for end in ends)])
        return math.ceil(needed_s / BUDGET_STEP_S) * BUDGET_STEP_S

    @property
    def advice(self) -> str:
        """What more time would do: how many rules are not judged for lack of it; empty if all are."""
        late = len(self.out_of_time)
        if not late:
            return ""
        what = f"{output.format_count(late, 'rule')} not judged for lack of time"
        advice = f"--budget {self.needed_budget} should judge them"
        if not self.is_incomplete:
            return f"{what}: {advice}"
        return f"not passed: {what}: {advice}; --select RULES judges fewer"

    @property
    def exit_code(self) -> int:
        """70 if a rule crashed, 3 if no instance could be built, 1 for errors and an incomplete check, 0 otherwise.

        A strict check has 1 also for warnings, and for any rule that it had no time to judge.
        """
        if self.verdict.crashed:
            return 70
        if self.records.built is None:
            return 3
        bad = (Severity.ERROR, Severity.WARNING) if self.strict else (Severity.ERROR,)
        is_bad = any(finding.severity in bad for finding in self.verdict.findings)
        return int(is_bad or self.fails_for_time)

    @property
    def fails_for_time(self) -> bool:
        """Whether rules that the check had no time to judge are enough to fail it."""
        return self.is_incomplete or (self.strict and bool(self.out_of_time))

    def locate(self, finding: RuleFinding) -> tuple[Path, int] | None:
        """Return file and line of what causes a finding: a call, else the method that it is about, else the class.

        Of an installed copy of a file of the current folder, that file.
        """
        place = self._locate(finding)
        return place and (prefer_working_copy(place[0]), place[1])

    def _locate(self, finding: RuleFinding) -> tuple[Path, int] | None:
        if finding.where is not None:
            return Path(finding.where[0]), finding.where[1]
        built = self.records.built
        if built is None or built.file is None:
            file = registry.find_source_file(self.task)
            return (file, 1) if file else None
        method = finding.evidence.get("call") or METHODS.get(finding.rule[:3], "")
        if RULES[finding.rule].is_about_space:
            kind = "action" if str(finding.evidence.get("element")).startswith("action") else "observation"
            method = f"{kind}_space" if f"{kind}_space" in built.places else method
        file_name, line = built.places.get(method) or (built.file, built.line or 1)
        return Path(file_name), line

    @property
    def outdated(self) -> str:
        """A line that says that Python imported another version of the task than the current folder has; or empty."""
        file = Path(self.records.built.file) if self.records.built and self.records.built.file else None
        file = file or registry.find_source_file(self.task)
        if file is None or self.task.rpartition(":")[0].endswith(".py") or not (pair := find_outdated(file)):
            return ""
        imported, own = pair[0], pair[1].relative_to(Path.cwd())
        return (
            f"warning: this checked {imported}, and {own} of this folder differs; "
            f"to check this folder: PYTHONPATH={find_root(own)} rlctl check-env {self.task}"
        )

    def fingerprint(self, finding: RuleFinding) -> str:
        """Return what identifies a finding in every run: no number of a message, which differ from run to run."""
        element = "" if RULES[finding.rule].shows_one else finding.evidence.get("element", "")
        return f"{self.task} {finding.rule} {element}".strip()

    def summarize(self) -> str:
        """Return a line that says what was found."""
        verdict = self.verdict
        counts = [(sum(finding.severity is s for finding in verdict.findings), s) for s in Severity]
        counted = ", ".join(output.format_count(count, severity) for count, severity in counts if count)
        waived = f", {len(verdict.waived)} waived" if verdict.waived else ""
        waived += f", {len(verdict.known)} known from the baseline" if verdict.known else ""
        judged = len(verdict.judged)
        found, rules = f"{counted or 'no findings'}{waived}", output.format_count(judged, "rule")
        if late := len(self.out_of_time):
            open_rules = f"{late} of {output.format_count(judged + late, 'rule')} not judged for lack of time"
            return (
                f"{self.task}: not finished: {open_rules} (needs --budget {self.needed_budget}); "
                f"{found} from the other {judged} "
                f"in {self.seconds:.1f} s"
            )
        return f"{self.task}: {found}; {rules} judged in {self.seconds:.1f} s"

    def subtract(self, baseline: Collection[str]) -> None:
        """Take out the findings whose fingerprints a baseline has: they are known, and fail nothing.

        Raises `UsageError` for a baseline of another task.
        """
        if baseline and not any(known.startswith(f"{self.task} ") for known in baseline):
            other = min(baseline).partition(" ")[0]
            raise UsageError(f"--baseline: its findings are of {other}, not of {self.task}: write the task as there")
        findings = self.verdict.findings
        occurring = {self.fingerprint(finding) for finding in (*findings, *self.verdict.waived)}
        gone = [known.removeprefix(f"{self.task} ") for known in sorted({*baseline} - occurring)]
        self.verdict.resolved = [known for known in gone if known.partition(" ")[0] in self.verdict.judged]
        self.verdict.known += [finding for finding in findings if self.fingerprint(finding) in baseline]
        self.verdict.findings = [finding for finding in findings if self.fingerprint(finding) not in baseline]


def check(
    spec: EnvSpec,
    *,
    env_timeout_s: float,
    rules: Sequence[str] = tuple(RULES),
    strict: bool = False,
    only: Collection[str] | None = None,
    budget_s: float | None = None,
    show_progress: bool = True,
) -> CheckReport:
    """Check an environment with some rules, by id; with `only`, from some of their experiments.

    Raises `UsageError` for a task or a parameter that does not exist. The report has every fault of the environment
    itself, also crashes, and calls that take more than `env_timeout_s` seconds. `budget_s` is the computing time of
    each process [s]; without it this is `PROCESS_S`, and up to `MOST_GROWTH` times as much where the steps are slow.
    """
    most_growth = MOST_GROWTH if budget_s is None else 1.0
    budget_s = budget_s or PROCESS_S
    started = time.monotonic()
    records = Records(spec.task, normalizes=lambda what: _normalizes(spec.task, what))

    needed = {"build"} | {name for name in find_needs(rules) if only is None or name in only}
    wanted = {process: [n for n in names if n in needed] for process, names in PROCESSES.items()}
    supervisor = Supervisor(spec, budget_s, env_timeout_s, records.add, most_growth)
    with show_status(f"checking {spec.task}", show_progress) as say:
        supervisor.run({process: names for process, names in wanted.items() if names}, say)
    records.printed_lines, records.printed_first = supervisor.children[0].printed, supervisor.children[0].first_line
    return CheckReport(spec.task, judge(records, rules), records, time.monotonic() - started, budget_s, strict)


def _normalizes(task: str, what: str) -> bool:
    if registry.find_recipe_file(task) is None:
        return False
    from rlctl.recipe import sources  # slow

    normalize = sources.resolve(task, None, {}).normalize
    return normalize is not None and bool(getattr(normalize, what))


@contextlib.contextmanager
def show_status(what: str, wanted: bool) -> Iterator[Callable[[str], None]]:
    """Show what is done (`checking reach`), without a terminal now and then; yields a function that takes the phase."""
    console = output.err()
    status = console.status(what)
    display: contextlib.AbstractContextManager[object] = contextlib.nullcontext()
    if wanted and console.is_terminal:
        display = status
    elif wanted:
        display = output.show_progress(what)
    with display:
        yield lambda phase: status.update(f"{what}: {phase}")


def judge(records: Records, rules: Collection[str] = tuple(RULES)) -> CheckVerdict:
    """Apply the rules; the findings come worst first. Raises `UsageError` for a waiver that cannot be used."""
    verdict = CheckVerdict(crashed={name: end.crash for name, end in records.finished.items() if end.crash})
    for rule in rules:
        _apply(rule, records, verdict)
    if any(finding.rule == "RL008" for finding in verdict.findings):
        for finding in [finding for finding in verdict.findings if RULES[finding.rule].allows_old_gym]:
            verdict.findings.remove(finding)
            verdict.not_judged[finding.rule] = "the environment is written for the old gym (RL008)"
    if records.built is not None:
        for finding in verdict.findings if records.built.names else ():
            if finding.fix == (general := RULES[finding.rule]).fix:
                finding.fix = general.task_fix
        _waive(verdict, records.built.waivers)
        for leaf in records.built.leaves:
            if not leaf.supported:
                verdict.not_judged[name_leaf(leaf)] = f"rules cannot examine a {leaf.kind} space"
    verdict.findings.sort(key=lambda finding: (finding.severity.rank, finding.rule))
    return verdict


def _apply(rule: str, records: Records, verdict: CheckVerdict) -> None:
    try:
        findings = _findings(rule, records, {finding.rule for finding in verdict.findings})
    except NotJudged as reason:
        verdict.not_judged[rule] = str(reason)
    except NotApplicable as reason:
        verdict.not_applicable[rule] = str(reason)
    except UsageError:  # the recipe that comes with the task
        raise
    except Exception:  # a bug in a rule must not hide other findings, and must not look like a pass
        verdict.crashed[rule] = traceback.format_exc()
    else:
        verdict.judged.append(rule)
        verdict.findings += findings


def _findings(rule: str, records: Records, earlier: set[str]) -> list[RuleFinding]:
    """Return the findings of a rule but those whose mistake is shown by another rule already: by an experiment, or by
    one of the `earlier` rules; those by expressions of the source only where it has found nothing else but infos."""
    found: set[str] = {finding.rule for finding in records.findings if rule not in finding.same}
    by_expressions: list[RuleFinding] = records.facts.get(BY_EXPRESSIONS, [])
    of_source = [one for one in by_expressions if one.rule == rule and not found & set(one.same)]
    try:
        played = [one for one in _find_played(rule, records) if not (found | earlier) & set(one.same)]
        return of_source if of_source and all(one.severity is Severity.INFO for one in played) else played
    except (NotJudged, NotApplicable):
        if not of_source:
            raise
        return of_source


def _find_played(rule: str, records: Records) -> list[RuleFinding]:
    judge_records, experiment = JUDGES.get(rule), DECIDED_BY.get(rule)
    findings = [finding for finding in records.findings if finding.rule == rule]
    if records.built is None and findings:
        return findings
    if RULES[rule].needs_instance:
        records.require_built()
    if judge_records is not None and not findings:
        findings += judge_records.run(records)
    if experiment is not None and not findings:
        if rule in records.skipped:
            raise NotJudged(records.skipped[rule])
        if rule in records.not_applicable:
            raise NotApplicable(records.not_applicable[rule])
        finished = records.finished.get(experiment.name)
        is_failed_build = records.built is None and experiment.name == "build"
        if not is_failed_build and (finished is None or not finished.is_complete):
            raise NotJudged(records.why_missing(experiment.name))
    if not findings or (judge_records is not None and judge_records.of_absence):
        records.require_whole(*find_needs([rule]))
    return findings


def _waive(verdict: CheckVerdict, waivers: Mapping[str, str]) -> None:
    for rule, reason in waivers.items():
        if rule not in RULES:
            form = 'Write rlctl_ignore = {"RL604": "the reason"}.'
            raise UsageError(f"rlctl_ignore: no rule {rule!r}.{did_you_mean(rule, RULES)} {form}")
        if not reason.strip():
            raise UsageError(f"rlctl_ignore: {rule} is waived without a reason; write why it is intended")
    verdict.waived = [finding for finding in verdict.findings if finding.rule in waivers]
    verdict.findings = [finding for finding in verdict.findings if finding.rule not in waivers]
