"""The policy that is exported: where it is, and whether its environment is still that of its training."""

from pathlib import Path

from rlctl import output
from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError, TaskError, UsageError
from rlctl.exporting.export_request import ExportRequest
from rlctl.policy.file import PolicyInfo
from rlctl.policy.shipped import PRETRAINED
from rlctl.runs import lookup
from rlctl.runs.directory import refuse_links_out
from rlctl.runs.lookup import FoundPolicy


def find_source(request: ExportRequest, name: str) -> tuple[FoundPolicy, Path]:
    """Return the policy to export, and the path of the files without their suffixes, which end in `name` by default."""
    source, target = lookup.find_policy(request.run, request.checkpoint), request.output
    output.print_notes(source.notes)
    if source.file.suffix == ".onnx":
        raise UsageError(f"{source.file} is an ONNX file already; export the run or its .safetensors file")
    if target is None:
        if source.run is not None:
            refuse_links_out(source.run.path)
        folder = Path() if request.checkpoint == PRETRAINED else source.file.parent
        stem = source.file.name if name == "policy" else f"{source.file.stem}-{name}.c"
        target = source.run.onnx_file.with_stem(name) if source.run else folder / stem
    return source, target


def explain_unverifiable(policy_file: Path, error: UsageError | TaskError) -> UsageError | TaskError:
    """Return the error for an environment that does not build."""
    message = f"{policy_file}: the export cannot be verified, because its environment does not build: {error}"
    return type(error)(message, details=error.details)


def check_environment(policy_file: Path, info: PolicyInfo, built: EnvInfo) -> None:
    """Raise `ArtifactError` if a policy's environment has changed since its training."""
    if difference := info.env.find_difference(built):
        raise ArtifactError(
            f"{policy_file}: the export cannot be verified, because its environment has changed: {difference}; "
            "train again, or restore the task's previous version"
        )
