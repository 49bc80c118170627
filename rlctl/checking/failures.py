"""The calls that raised, died or hung."""

from collections.abc import Iterator

from rlctl.checking.records import CallFailure, Records

OF_OTHER_RULES = ("interleaved", "after close", "rendering", "nan action")
"""Failures there are those of RL401, RL402, RL215 and RL704."""


def select_failures(records: Records, kind: str) -> Iterator[CallFailure]:
    """Yield the calls that raised, died or hung on an instance that was alone and used properly, each error once."""
    errors: set[tuple[str, str]] = set()
    for failure in records.failures:
        if failure.kind != kind or failure.call in ("load", "build") or failure.phase in OF_OTHER_RULES:
            continue
        if (failure.call, failure.error) not in errors:
            errors.add((failure.call, failure.error))
            yield failure
