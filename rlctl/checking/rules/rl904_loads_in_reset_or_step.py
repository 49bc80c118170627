"""RL904: loads in reset or step."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.speed import NAMED_CALLS, add_shares, find_loading, format_time, name_call_place, require_times

RULE = Rule(
    "RL904",
    "loads in reset or step",
    Severity.WARNING,
    meaning="""
        reset, or even step, loads models, reads files or connects to a simulator, and that takes a large part
        of an episode. A world that is loaded once and restored resets a hundred times faster. A new connection
        per reset is always reported: ids of the old one become invalid, and a client that is not disconnected
        remains. Tasks of rlctl with fast_reset = False must load in reset, and are not judged.
    """,
    fix="""
        Connect and load once, in __init__; in reset restore a state saved right after loading (saveState,
        restoreState), or set back what step changes.
    """,
)

LITTLE_LOADING = 0.05  # Share of an episode below which loading in reset is not reported


@judges_records(RULE, "speed", "episodes")
def _find_loading(records: Records) -> Iterator[RuleFinding]:
    speed, step_s, reset_s, steps = require_times(records)
    for call, call_s, part, whole_s in (
        ("reset", reset_s, "an episode", reset_s + steps * step_s),
        ("step", step_s, "its time", step_s),
    ):
        calls = find_loading(speed, call)
        seconds = call_s * add_shares(calls)
        share = seconds / whole_s if whole_s else 0.0
        connects = any(call.kind == "connecting" for call in calls)
        if calls and (connects or call == "step" or share >= LITTLE_LOADING):
            named = sorted(calls, key=lambda call: (call.kind != "connecting", -call.share))
            names = list_names([f"{timed.name}{name_call_place(timed)}" for timed in named], NAMED_CALLS)
            message = f"{call} calls {names}: {format_time(seconds)} per {call}, {share:.0%} of {part}"
            evidence = {"call": call, "value": [timed.name for timed in named], "ms": 1e3 * seconds, "share": share}
            severity = Severity.WARNING if share >= LITTLE_LOADING else Severity.INFO
            yield RuleFinding(RULE, message, evidence, severity)
