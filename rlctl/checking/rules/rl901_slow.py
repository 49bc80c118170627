"""RL901: slow."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.speed import MILLION, Speed, add_shares, find_idle, find_loading, list_calls

RULE = Rule(
    "RL901",
    "slow",
    Severity.WARNING,
    meaning="""
        A million steps, which is a small training, take more than about three hours per process. Parallel
        environments help up to the number of cores; a faster step helps everywhere. Time that RL903 and RL904
        report is not counted here. An info if no single call takes a quarter of a step.
    """,
    fix="""
        Begin with the call named first. In a simulation: fewer or longer substeps, simpler collision shapes,
        fewer solver iterations, no unneeded self-collision; in Python: one call for all joints instead of one
        per joint.
    """,
)

SLOW_STEPS_PER_S = 100.0  # a million steps then take about three hours [steps/s]
CLEARLY_SLOW = 1.25  # So many times slower than that is a warning; less may be a busy machine
LARGE_CALL = 0.25  # share of a step; where no call takes so much, a slow step is an info: there is no place to begin


@judges_records(RULE, "speed")
def _find_slow_step(records: Records) -> Iterator[RuleFinding]:
    speed: Speed = records.require_fact("speed")
    if speed.step_s is None:
        raise NotJudged("no step could be timed")
    named_elsewhere = find_idle(records, speed, "step") + find_loading(speed, "step")
    left = speed.step_s * (1 - add_shares(named_elsewhere))
    if left * SLOW_STEPS_PER_S <= 1:
        return
    per_s, hours, slowest = 1 / speed.step_s, MILLION * speed.step_s / 3600, list_calls(speed.slowest_in_step)
    time = f"a million steps take {hours:,.3g} hours per process on this machine"
    evidence = {"value": per_s, "expected": SLOW_STEPS_PER_S, "step_ms": 1e3 * speed.step_s, "steps": speed.steps}
    is_clear = left * SLOW_STEPS_PER_S > CLEARLY_SLOW
    has_large_call = any(call.share >= LARGE_CALL for call in speed.slowest_in_step)
    severity = Severity.WARNING if is_clear and has_large_call else Severity.INFO
    yield RuleFinding(RULE, f"{per_s:,.3g} steps/s: {time}; slowest: {slowest}", evidence, severity)
