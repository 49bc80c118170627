"""RL4: instances do not touch each other. Training steps dozens of them in one process."""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.comparison import first_difference
from rlctl.check_env.evidence import Evidence, Failure, Trajectory
from rlctl.check_env.finding import NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import SharedSpaces
from rlctl.check_env.rules.determinism import compared
from rlctl.check_env.rules.interface import calls_alone, where
from rlctl.check_env.rules.known import built, one, result

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

CLIENT_FIX = (
    "Give each instance its own state. With PyBullet: keep the id that p.connect returned and pass "
    "physicsClientId=self.client to every call, p.disconnect included."
)


def _require_alone(evidence: Evidence) -> None:
    """Instances can only be compared if two that live the same, one after the other, do the same."""
    if compared(evidence, "fresh process", "fresh instance")[1] is not None:
        raise NotJudged("two instances differ already when they are alone (RL301 to RL304)")


def _failures(evidence: Evidence, phase: str) -> Iterator[Failure]:
    alone = {(failure.call, failure.error) for failure in calls_alone(evidence, "raised")}
    for failure in evidence.failures:
        is_known = (failure.call, failure.error) in alone
        if failure.process == "instances" and failure.phase == phase and failure.call != "build" and not is_known:
            yield failure


def _failed(failure: Failure, doing: str) -> Seen:
    verb = "raised" if failure.kind == "raised" else "ended:" if failure.kind == "died" else "hangs:"
    at = f"step {failure.step}" if failure.call == "step" else failure.call
    error = failure.error if failure.kind == "raised" else f"the process {failure.error}"
    return Seen(f"{doing}, {at} {verb} {error}", where(failure))


def _differs(evidence: Evidence, lived: Trajectory, doing: str) -> Iterator[Seen]:
    alone = one(evidence, "fresh process" if lived.seed == one(evidence, "fresh process").seed else "second alone")
    if alone.ended == "raised":
        raise NotJudged("the episode raised when alone, too (RL207)")
    difference = first_difference(built(evidence), alone, lived)
    if difference is not None:
        severity = WARNING if difference.is_small else None
        yield Seen(f"{doing}: {difference.text()}", difference.evidence(lived), severity)


@rule("RL401", "instances share a world", ERROR, CLIENT_FIX)
def interleaved(evidence: Evidence) -> Iterator[Seen]:
    """Two instances stepped in turns behave otherwise than one alone: they share a simulation or other state, so
    every environment of a training disturbs every other."""
    _require_alone(evidence)
    doing = "two instances stepped in turns"
    for failure in _failures(evidence, "interleaved"):
        yield _failed(failure, doing)
        return
    one(evidence, "interleaved")
    for lived in evidence.role("interleaved"):
        for seen in _differs(evidence, lived, f"{doing}, against one alone"):
            yield seen
            return


@rule("RL402", "closing breaks another instance", ERROR, CLIENT_FIX)
def closing(evidence: Evidence) -> Iterator[Seen]:
    """Closing one instance breaks another, or changes what it does: close ends something they share."""
    _require_alone(evidence)
    doing = "after another instance was closed"
    for failure in _failures(evidence, "after close"):
        yield _failed(failure, doing)
        return
    if list(interleaved.run(evidence)):
        raise NotJudged("the instances already disturb each other while both are open (RL401)")
    yield from _differs(evidence, one(evidence, "after close"), f"{doing}, against one alone")


@rule(
    "RL403",
    "no second instance",
    ERROR,
    "Open nothing exclusively (a port, a file, a display) in the constructor, or choose a free one per instance.",
)
def second_instance(evidence: Evidence) -> Iterator[Seen]:
    """A second environment, in the same process or in another at the same time, cannot be built. Training needs
    many."""
    built(evidence)
    for failure in evidence.failures:
        if failure.call in ("load", "build") and failure.process != "probe":
            beside = "in one process" if failure.phase in ("fresh instance", "interleaved") else "in a second process"
            yield Seen(f"a second instance {beside} cannot be built: {failure.error}", where(failure))
            return


@rule(
    "RL404",
    "instances share a space",
    WARNING,
    "Make the spaces in the constructor, self.action_space = spaces.Box(...), not on the class or in the module.",
    needs=("attributes",),
)
def shared_spaces(evidence: Evidence) -> Iterator[Seen]:
    """Two instances have one space object, or one random generator in theirs. Seeding or sampling the actions of one
    changes what the other draws: the random actions of a training cannot be repeated, or are the same everywhere."""
    if not built(evidence).is_env:
        raise NotJudged("it is no gymnasium.Env (RL003)")
    shared = result(evidence, SharedSpaces, "attributes")
    for what, names in (("", shared.objects), (" random generator", shared.generators)):
        if names:
            # Nobody samples observations.
            severity = WARNING if "action_space" in names else INFO
            spaces = " and ".join(f"the {name}'s{what}" if what else name for name in names)
            message = f"two instances have one object as {spaces}" if not what else f"two instances share {spaces}"
            yield Seen(message, {"value": names, "expected": []}, severity)
