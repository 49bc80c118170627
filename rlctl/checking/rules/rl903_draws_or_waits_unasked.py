"""RL903: draws or waits unasked."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.speed import Speed, find_idle, format_time, name_call_place

RULE = Rule(
    "RL903",
    "draws or waits unasked",
    Severity.WARNING,
    meaning="""
        step or reset renders, draws or sleeps although no render mode was requested: nobody sees it, and every
        step pays for it. Rendering is fine if the observation has an image.
    """,
    fix="""
        Render only in render(), and call that from step only if render_mode is "human"; sleep only there, to
        show the simulation in real time.
    """,
)


@judges_records(RULE, "speed")
def _find_drawing_and_waiting(records: Records) -> Iterator[RuleFinding]:
    speed: Speed = records.require_fact("speed")
    for call, seconds in (("step", speed.step_s), ("reset", speed.reset_s)):
        for timed in find_idle(records, speed, call):
            lost = format_time(timed.share * seconds) if seconds else "?"
            message = (
                f"{call} calls {timed.name}{name_call_place(timed)}: {lost} per {call}, {timed.share:.0%} of its time"
            )
            evidence = {"call": call, "value": timed.name, "place": timed.place, "share": timed.share}
            yield RuleFinding(RULE, message, evidence)
