"""What families that are not converted yet use. Goes when the last one is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from rlctl.check_env.experiment import PROVOKING, RECORDING, Check, Experiment
from rlctl.check_env.finding import Finding, Severity
from rlctl.check_env.messages import Built, Fact, Skipped, Trajectory
from rlctl.check_env.records import Records
from rlctl.check_env.studies import STUDIES

T = TypeVar("T")
LIVES = RECORDING
Evidence = Records


@dataclasses.dataclass(frozen=True)
class Seen:
    message: str
    evidence: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    severity: Severity | None = None
    fix: str | None = None


def rule(
    id: str,
    name: str,
    severity: Severity,
    fix: str,
    *,
    needs: Iterable[str] = LIVES,
    complaints: Any = (),
    only_complaints: bool = False,
) -> Callable[[Callable[[Records], Iterable[Seen]]], Any]:
    def decorate(run: Callable[[Records], Iterable[Seen]]) -> Any:
        def check(records: Records) -> Iterable[Finding]:
            for seen in run(records):
                yield Finding(id, seen.message, seen.evidence, seen.severity, seen.fix or "")

        return None if only_complaints else Check(id, check, tuple(needs))

    return decorate


def result(value: Any) -> Fact:
    return Fact(type(value).__name__, value)


def skip(study: str, reason: str) -> Skipped:
    return Skipped(study, reason)


def built(evidence: Records) -> Built:
    return evidence.require_built()


def lived(evidence: Records) -> list[Trajectory]:
    return evidence.require_alone()


def one(evidence: Records, role: str) -> Trajectory:
    return evidence.require_role(role)


def known_result(evidence: Records, kind: type[T], study: str) -> T:
    found: T = evidence.require_fact(kind.__name__, study)
    return found


def why_missing(evidence: Records, study: str) -> str:
    return evidence.why_missing(study)


def old_experiment(name: str) -> Experiment:
    study = next(each for each in STUDIES if each.name == name)
    if study.provokes:
        PROVOKING.add(name)
    return Experiment(name, study.run, (), study.share, "provoked" if study.provokes else "")
