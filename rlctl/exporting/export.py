"""`rlctl export`: a policy file becomes an ONNX file or C source, which stays only if it acts the same."""

from __future__ import annotations

import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rlctl.errors import AnswerIsNo, ArtifactError, TaskError, UsageError
from rlctl.exporting.report import ExportReport, format_agreement, format_closed_loop
from rlctl.exporting.request import ExportRequest
from rlctl.output import print_notes
from rlctl.policy import onnx_file
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.numpy_policy import check_playable
from rlctl.policy.own_modules import KEYS, import_named
from rlctl.policy.policy import Policy
from rlctl.policy.shipped import PRETRAINED
from rlctl.rollout.workers import Workers, available_cores
from rlctl.run import lookup
from rlctl.run.lookup import FoundPolicy
from rlctl.storage import files

if TYPE_CHECKING:
    import onnx

    from rlctl.exporting.c_source import CSource
    from rlctl.exporting.verify import Agreement, ClosedLoop
    from rlctl.policy.torch_policy import TorchPolicy

C_OBSERVATIONS = 2000
"""On which a C function is compared."""


class _Export(NamedTuple):
    # What the exports of one policy share.
    file: Path
    info: PolicyInfo
    policy: TorchPolicy
    workers: Workers


def export_policy(request: ExportRequest) -> list[ExportReport]:
    """Export a policy in one or more formats and verify each file in the policy's own environment.

    Of several formats each file has its own suffix. Raises `UsageError` for a policy that has no such form, and
    `AnswerIsNo` with the numbers if a file does not act as the policy does; then that file is not left.
    """
    source, formats, output = lookup.find_policy(request.run, request.checkpoint), request.formats, request.output
    print_notes(source.notes)
    if source.file.suffix == ".onnx":
        raise UsageError(f"{source.file}: an ONNX file already; export the run or its .safetensors file")
    if output is None:
        beside = Path() if request.checkpoint == PRETRAINED else source.file.parent
        output = source.run.onnx_file if source.run else beside / source.file.name
        output = output.with_suffix(f".{formats[0]}")
    return _export(source, [output.with_suffix(f".{name}") for name in formats])


def _export(source: FoundPolicy, targets: list[Path]) -> list[ExportReport]:
    policy = check_playable(PolicyFile.read(source.file))
    if source.run is not None and any(isinstance(policy.info.policy_kwargs.get(key), dict) for key in KEYS):
        import_named(source.run.recipe().policy_kwargs)  # they are the user's, whose run names them
    info = policy.info
    # The environments are built while torch is imported.
    with Workers(source.locate(info.spec), available_cores()) as workers:
        from rlctl.exporting.actor import build
        from rlctl.exporting.c_source import write_c
        from rlctl.policy.torch_policy import TorchPolicy, pin_threads

        pin_threads()
        models = [(target, build(policy)) for target in targets if target.suffix == ".onnx"]
        sources = [(target, write_c(policy, target.stem)) for target in targets if target.suffix == ".c"]
        job = _Export(source.file, info, TorchPolicy.load(source.file), workers)
        _check_environment(source.file, info, workers)
        return [*(_export_onnx(job, *model) for model in models), *(_export_c(job, *source) for source in sources)]


def _check_environment(policy_file: Path, info: PolicyInfo, workers: Workers) -> None:
    try:
        built = workers.info
    except (UsageError, TaskError) as error:
        message = f"{policy_file}: the export cannot be verified, its environment does not build: {error}"
        raise type(error)(message, details=error.details) from None
    if difference := info.env.find_difference(built):
        raise ArtifactError(
            f"{policy_file}: the export cannot be verified, its environment has changed: {difference}; "
            "train again, or go back to the task's former version"
        )


def _export_onnx(job: _Export, target: Path, model: onnx.ModelProto) -> ExportReport:
    from rlctl.policy.onnx_policy import OnnxPolicy

    reports: list[ExportReport] = []

    def write(part: Path) -> None:
        part.write_bytes(onnx_file.encode(model))
        exported = OnnxPolicy.load(part)
        ports = {"inputs": exported.session.get_inputs(), "outputs": exported.session.get_outputs()}
        opset, size = model.opset_import[0].version, part.stat().st_size
        reports.append(
            ExportReport(
                **_verify(job, target, exported, part, "the ONNX file", 1000),
                size=size,
                written=f"{target} ({size / 1000:,.1f} kB, opset {opset})",
                interface=[(kind, ", ".join(map(_format_port, some))) for kind, some in ports.items()],
                next=shlex.join(["rlctl", "eval", str(target), "--task", job.info.spec.task]),
                details={"opset": opset} | {kind: [_describe_port(port) for port in ports[kind]] for kind in ports},
            )
        )

    files.write_with(target, write)
    return reports[0]


def _describe_port(port: Any) -> dict[str, Any]:
    return {"name": port.name, "dtype": port.type.removeprefix("tensor(").removesuffix(")"), "shape": port.shape}


def _format_port(port: Any) -> str:
    name, dtype, shape = _describe_port(port).values()
    return f"{name} {dtype}[{', '.join(map(str, shape))}]"


def _export_c(job: _Export, target: Path, code: CSource) -> ExportReport:
    from rlctl.exporting.c_source import build_library, find_compiler
    from rlctl.policy.c_policy import CPolicy

    compiler = find_compiler()
    # The name of a header is in the source, and a file's may not be an identifier: policy-1.c includes policy_1.h.
    header = target.with_name(f"{code.name}.h")
    if compiler is None:
        seen = {**_describe(job, target), "not_verified": "no C compiler (cc, or $CC) on this machine"}
    else:
        with tempfile.TemporaryDirectory(prefix="rlctl-") as folder:
            library = build_library(code, job.info, Path(folder), compiler)
            seen = _verify(job, target, CPolicy.load(library), library, "the C function", C_OBSERVATIONS)
    files.write_text(header, code.header)
    files.write_text(target, code.source)
    size = len(code.source.encode()) + len(code.header.encode())
    return ExportReport(
        **seen,
        size=size,
        written=f"{target} and {header.name} ({size / 1000:,.1f} kB, C99)",
        interface=[("function", code.prototype)],
        next=shlex.join(["cc", "-std=c99", "-O3", "-c", str(target)]),
        details={"header": header, "prototype": code.prototype, "compiler": (compiler or [""])[0]},
    )


def _describe(job: _Export, target: Path) -> dict[str, Any]:
    info = job.info
    return {
        "path": target,
        "policy": job.file,
        "task": info.spec.task,
        "algo": info.algo,
        "training_steps": info.training_steps,
    }


def _verify(
    job: _Export, target: Path, exported: Policy, file: Path, what: str, min_observations: int
) -> dict[str, Any]:
    """Return what a report says of a verified file."""
    from rlctl.exporting.verify import measure_latency, verify

    agreement, loop = verify(job.policy, exported, file, job.workers, min_observations)
    if not (agreement.agrees and (loop.agrees or loop.magnified)):
        raise AnswerIsNo(_explain_failure(job, target, what, agreement, loop))
    latency = measure_latency(job.policy, exported)
    return {**_describe(job, target), "agreement": agreement, "closed_loop": loop, "latency": latency}


def _explain_failure(job: _Export, target: Path, what: str, agreement: Agreement, loop: ClosedLoop) -> str:
    why = f"{what} does not act as {job.file} does"
    if agreement.agrees:
        why = (
            "every action agrees, but the episodes do not: is the environment reproducible? "
            f"rlctl check-env {job.info.spec.task}"
        )
    return f"{target}: not verified, not written: {why}\n{format_agreement(agreement)}\n{format_closed_loop(loop)}"
