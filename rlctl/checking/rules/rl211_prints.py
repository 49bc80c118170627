"""RL211: prints."""

from collections.abc import Iterator

from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL211",
    "prints",
    Severity.INFO,
    meaning="""
        The environment writes to standard output. With many environments this hides all other output, and a
        line per step is slow.
    """,
    fix="Use the logging module, or put the values into info.",
)

MANY_LINES, FEWEST_STEPS = 0.5, 20  # lines per step; with fewer steps most lines come from the start


@judges_records(RULE, *RECORDING)
def _find_prints(records: Records) -> Iterator[RuleFinding]:
    if lines := records.printed_lines:
        steps = max(1, sum(trajectory.steps for trajectory in records.trajectories))
        message = f"{lines} lines on stdout in {steps} steps, the first: {records.printed_first[:80]!r}"
        severity = Severity.WARNING if steps >= FEWEST_STEPS and lines > max(20, MANY_LINES * steps) else None
        yield RuleFinding(RULE, message, {"value": lines, "expected": 0}, severity)
