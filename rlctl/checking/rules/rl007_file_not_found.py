"""RL007: file not found."""

from collections.abc import Iterator, Mapping
from typing import Any

from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.experiments.build import FailedBuild, explains_failures
from rlctl.checking.instance import find_missing_file
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL007",
    "file not found",
    Severity.ERROR,
    meaning="""
        A model, URDF or other file that the environment loads does not exist. Relative paths depend on the
        current folder, and workers and CI start in other folders.
    """,
    fix="""
        Build the path from the module's own folder, Path(__file__).parent; for PyBullet's own models, call
        setAdditionalSearchPath(pybullet_data.getDataPath()) on the same client.
    """,
    needs_instance=False,
)


@judges_records(RULE, "build", *RECORDING)
def _find_missing_files(records: Records) -> Iterator[RuleFinding]:
    files = set()
    for failure in records.failures if records.built is not None else ():
        if failure.file is not None and failure.file["file"] not in files:
            files.add(failure.file["file"])
            yield _not_found(failure.call, failure.file, failure.details)


@explains_failures(RULE, place=40, decides=False)
def _explain_missing_file(failed: FailedBuild) -> Iterator[RuleFinding]:
    if (file := find_missing_file(failed.cause)) is not None:
        yield _not_found("the constructor", file, failed.error.details)


def _not_found(call: str, file: Mapping[str, Any], details: str | None) -> RuleFinding:
    where = f", looked for in {' and '.join(file['searched'])}" if file["searched"] else ""
    where = f": it is in {file['found']}; call setAdditionalSearchPath first" if file["found"] else where
    evidence = {**file, "traceback": details} if details else dict(file)
    return RuleFinding(RULE, f"{call} does not find {file['file']!r}{where}", evidence)
