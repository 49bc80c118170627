"""What a run has learned, next to scripted competitors: `rlctl runs show --audit`."""

import dataclasses
from typing import Any

from rlctl.checking.audit import FORMAT
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError
from rlctl.policy.file import PolicyFile
from rlctl.runs.directory import RunDirectory
from rlctl.runs.lookup import FoundPolicy
from rlctl.storage import files


def audit_run(run: RunDirectory, *, env_timeout_s: float) -> None:
    """Let the policy of a run play against the competitors of its task, and write the result into the run.

    Raises `ArtifactError` for a run without a policy, and what `audit` raises.
    """
    from rlctl.checking.audit.audit import audit
    from rlctl.checking.audit.competitors import LEARNED
    from rlctl.checking.audit.report import to_json

    which = "best" if run.best_policy.is_file() else "last"
    file = run.policy_file(which)
    spec = FoundPolicy(file, run).locate(PolicyFile.read_info(file).derive_spec())
    spec.constructor()  # raises for a file that names anything but an environment
    bare = dataclasses.replace(spec.observe_as(EnvSpec(spec.task)), stage=0)
    report = audit(bare, env_timeout_s=env_timeout_s, learned=file.resolve())
    if not report.ranking.learned:
        raise ArtifactError(f"{file}: not played: {report.not_played.get(LEARNED, 'time ran out')}")
    files.write_json(run.audit_file, {**to_json(report), "policy": which})


def read_audit(run: RunDirectory) -> dict[str, Any] | None:
    """Return what was found last; None if nothing was. Raises `ArtifactError` for a file of something else."""
    if not run.audit_file.is_file():
        return None
    content = files.read_json(run.audit_file)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ArtifactError(f"{run.audit_file}: not an audit of this rlctl; write it again: rlctl runs show --audit")
    return content


def list_lines(found: dict[str, Any]) -> list[str]:
    """Return what the policy has learned, and what the reward pays for, as lines."""
    lines = [found.get("learned"), found.get("verdict")]
    return [f"audit: {line}" for line in lines if isinstance(line, str) and line]
