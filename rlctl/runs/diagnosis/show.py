"""Findings as lines for a terminal, and as plain data."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

from rlctl.runs.diagnosis.findings import Finding, Grade


def format_finding(finding: Finding) -> list[str]:
    """Return a finding with its evidence, its meaning and what to try."""
    settings = [
        f"  {each.name} is {'not set' if each.value is None else each.value}: {each.advice}"
        for each in finding.settings
    ]
    return [finding.line, f"  {finding.meaning}", *(f"  try: {each}" for each in finding.advice), *settings]


def format_end(findings: Sequence[Finding], run: str) -> list[str]:
    """Return what a training says at its end: warnings in full, the rest in one line; nothing where all is well."""
    warnings = [each for each in findings if each.grade == Grade.WARNING]
    others = [f"{each.id} {each.name}" for each in findings if each.grade != Grade.WARNING]
    lines = [line for each in warnings for line in format_finding(each)]
    return [*lines, f"noted: {', '.join(others)}; more: rlctl runs show {run}"] if others else lines


def as_json(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Return findings as plain data."""
    return [dataclasses.asdict(each) for each in findings]
