"""The policy that a log is compared with, its task, and the other policies of its run."""

import contextlib
import dataclasses

from rlctl.environments.spec import UNCHANGED, EnvChanges, EnvSpec
from rlctl.errors import ArtifactError, UsageError
from rlctl.policy.file import PolicyFile
from rlctl.policy.load import check_playable
from rlctl.runs.lookup import find_policy

_MOST_OTHERS = 20


@dataclasses.dataclass(frozen=True, eq=False)
class PolicyOrigin:
    """A policy, how to build its environment, and other policies of the same run."""

    policy: PolicyFile
    spec: EnvSpec
    others: tuple[PolicyFile, ...]
    notes: tuple[str, ...]


def find_source(policy: str | None, checkpoint: str, changes: EnvChanges = UNCHANGED) -> PolicyOrigin:
    """Find the policy that `--policy` and `--checkpoint` name; raises `UsageError` for an exported file."""
    found = find_policy(policy, checkpoint)
    if found.file.suffix == ".onnx":
        raise UsageError(f"{found.file}: diagnose needs the policy file (.safetensors), which has the normalisation")
    own = check_playable(PolicyFile.read(found.file)).actor_only()
    files = sorted(found.file.parent.glob("*.safetensors"))
    if found.run is not None:
        files += sorted(found.run.path.glob("checkpoints/*/*.safetensors"))
    others = []
    for file in files[-_MOST_OTHERS:]:
        if file != found.file:
            with contextlib.suppress(ArtifactError, UsageError):  # a damaged or foreign file is no explanation
                other = PolicyFile.read(file)
                if own.info.env.find_difference(other.info.env) is None:
                    others.append(check_playable(other).actor_only())
    spec = found.locate(own.info.derive_spec(changes=changes))
    return PolicyOrigin(own, spec, tuple(others), found.notes)
