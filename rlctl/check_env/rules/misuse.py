"""How an environment takes what no learner should do: it should refuse, in words."""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.evidence import Evidence, Failure
from rlctl.check_env.finding import NotApplicable, NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import ActionEffects, NanAction
from rlctl.check_env.rules.known import built, result

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO


def _ended(evidence: Evidence, study: str, doing: str) -> Iterator[Seen]:
    """Yield what ended the process, or did not come back, in a study."""
    for failure in _ends(evidence, study):
        how = f"the process {failure.error}" if failure.kind == "died" else failure.error
        yield Seen(f"{doing} {'hangs' if failure.kind == 'hung' else 'ends it all'}: {how}", failure.place, ERROR)


def _ends(evidence: Evidence, study: str) -> list[Failure]:
    built(evidence)
    return [each for each in evidence.failures if each.phase == study and each.kind in ("died", "hung")]


@rule(
    "RL704",
    "NaN action accepted",
    WARNING,
    "Raise an exception in step() for an action that is not finite.",
    needs=("nan action", "action effects"),
)
def nan_action(evidence: Evidence) -> Iterator[Seen]:
    """An action of NaN is accepted. If finite observations come back it is swallowed: a policy that has diverged goes
    on as if nothing were wrong. If NaN comes back it spreads at least where it can be seen, though late."""
    if not any(leaf.kind == "Box" and leaf.dtype.startswith("float") for leaf in built(evidence).action_leaves):
        raise NotApplicable("no continuous action")
    if not built(evidence).is_env:
        raise NotJudged("it is no gymnasium.Env (RL003)")
    ended = list(_ended(evidence, "nan action", "an action of NaN"))
    yield from ended
    if ended:
        return
    found = result(evidence, NanAction, "nan action")
    if found.raised is not None:
        return
    effects = evidence.facts.get(ActionEffects.__name__)
    if effects is not None and all(each.effect == "none" for each in effects.dimensions):
        raise NotJudged("no action has any effect (RL701)")
    place = {"seed": found.seed, "step": found.step, "expected": "an exception"}
    if found.finite:
        yield Seen("an action of NaN is swallowed: only finite numbers come back", {**place, "value": "finite"})
    else:
        yield Seen("an action of NaN is accepted, and NaN comes back", {**place, "value": "nan"}, INFO)
