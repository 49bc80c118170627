"""`rlctl export`: write a policy as an ONNX file or C source, and keep the file only if it acts as the policy does."""

from __future__ import annotations

import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl.errors import AnswerIsNo, ArtifactError, TaskError, UsageError
from rlctl.exporting.report import ExportReport, format_agreement, format_closed_loop
from rlctl.exporting.request import ExportRequest
from rlctl.exporting.verify import MIN_OBSERVATIONS, measure_latency, verify
from rlctl.hub import store
from rlctl.output import print_notes
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.numpy_policy import check_playable
from rlctl.policy.own_modules import KEYS, import_named
from rlctl.policy.policy import Policy
from rlctl.policy.shipped import PRETRAINED
from rlctl.rollout.workers import Workers, available_cores
from rlctl.run import lookup
from rlctl.run.directory import refuse_links_out
from rlctl.run.lookup import FoundPolicy
from rlctl.storage import files

if TYPE_CHECKING:
    import onnx

    from rlctl.exporting.c_source import CSource
    from rlctl.policy.torch_policy import TorchPolicy

C_OBSERVATIONS = 2000  # number of observations on which a C function is compared


def export_policy(request: ExportRequest) -> list[ExportReport]:
    """Export a policy in one or more formats and verify each file in the policy's own environment.

    The files of several formats differ in their suffix. Raises `UsageError` for a policy that a format cannot hold,
    and `AnswerIsNo` with the numbers if a file does not act as the policy does; that file is not written.
    """
    source, formats, output = lookup.find_policy(request.run, request.checkpoint), request.formats, request.output
    print_notes(source.notes)
    if source.file.suffix == ".onnx":
        raise UsageError(f"{source.file} is an ONNX file already; export the run or its .safetensors file")
    if output is None:
        if source.run is not None:
            refuse_links_out(source.run.path)
        folder = Path() if request.checkpoint == PRETRAINED else source.file.parent
        output = source.run.onnx_file if source.run else folder / source.file.name
        output = output.with_suffix(f".{formats[0]}")
    return _export(source, [output.with_suffix(f".{name}") for name in formats])


def _export(source: FoundPolicy, targets: list[Path]) -> list[ExportReport]:
    policy = check_playable(PolicyFile.read(source.file))
    has_own = any(isinstance(policy.info.policy_kwargs.get(key), dict) for key in KEYS)
    if source.run is not None and has_own and not store.is_cached(source.run.path):
        import_named(
            source.run.recipe().policy_kwargs
        )  # named by the user's run; others write runs that are downloaded
    info = policy.info
    # The environments are built while torch is imported.
    with Workers(source.locate(info.spec), available_cores()) as workers:
        from rlctl.exporting.actor import build
        from rlctl.exporting.c_source import write_c
        from rlctl.policy.torch_policy import TorchPolicy, pin_threads

        pin_threads()
        models = [(target, build(policy)) for target in targets if target.suffix == ".onnx"]
        sources = [(target, write_c(policy, target.stem)) for target in targets if target.suffix == ".c"]
        torch_policy = TorchPolicy.load(source.file)
        _check_environment(source.file, info, workers)
        return [
            *(_export_onnx(torch_policy, workers, target, model) for target, model in models),
            *(_export_c(torch_policy, workers, target, code) for target, code in sources),
        ]


def _check_environment(policy_file: Path, info: PolicyInfo, workers: Workers) -> None:
    try:
        built = workers.info
    except (UsageError, TaskError) as error:
        message = f"{policy_file}: the export cannot be verified, because its environment does not build: {error}"
        raise type(error)(message, details=error.details) from None
    if difference := info.env.find_difference(built):
        raise ArtifactError(
            f"{policy_file}: the export cannot be verified, because its environment has changed: {difference}; "
            "train again, or restore the task's previous version"
        )


def _export_onnx(policy: TorchPolicy, workers: Workers, target: Path, model: onnx.ModelProto) -> ExportReport:
    from rlctl.policy.onnx_policy import OnnxPolicy, encode

    reports: list[ExportReport] = []

    def write(part: Path) -> None:
        part.write_bytes(encode(model))
        exported = OnnxPolicy.load(part)
        ports = {"inputs": exported.session.get_inputs(), "outputs": exported.session.get_outputs()}
        opset, size = model.opset_import[0].version, part.stat().st_size
        reports.append(
            ExportReport(
                **_verify(policy, workers, target, exported, part, "the ONNX file"),
                size=size,
                written=f"{target} ({size / 1000:,.1f} kB, opset {opset})",
                interface=[(kind, ", ".join(map(_format_port, ports[kind]))) for kind in ports],
                next=shlex.join(["rlctl", "eval", str(target), "--task", policy.info.spec.task]),
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


def _export_c(policy: TorchPolicy, workers: Workers, target: Path, code: CSource) -> ExportReport:
    from rlctl.exporting.c_source import build_library, find_compiler
    from rlctl.policy.c_policy import CPolicy

    compiler = find_compiler()
    # The source includes the header by the identifier: policy-1.c includes policy_1.h.
    header = target.with_name(f"{code.name}.h")
    if compiler is None:
        fields = {**_describe(policy, target), "not_verified": "no C compiler (cc, or $CC) on this machine"}
    else:
        with tempfile.TemporaryDirectory(prefix="rlctl-") as folder:
            library = build_library(code, policy.info, Path(folder), compiler)
            exported = CPolicy.load(library)
            fields = _verify(policy, workers, target, exported, library, "the C function", C_OBSERVATIONS)
    files.write_text(header, code.header)
    files.write_text(target, code.source)
    size = len(code.source.encode()) + len(code.header.encode())
    return ExportReport(
        **fields,
        size=size,
        written=f"{target} and {header.name} ({size / 1000:,.1f} kB, C99)",
        interface=[("function", code.prototype)],
        next=shlex.join(["cc", "-std=c99", "-O3", "-c", str(target)]),
        details={"header": header, "prototype": code.prototype, "compiler": (compiler or [""])[0]},
    )


def _describe(policy: TorchPolicy, target: Path) -> dict[str, Any]:
    info = policy.info
    return {
        "path": target,
        "policy": policy.file.path,
        "task": info.spec.task,
        "algo": info.algo,
        "training_steps": info.training_steps,
    }


def _verify(
    policy: TorchPolicy,
    workers: Workers,
    target: Path,
    exported: Policy,
    file: Path,
    what: str,
    min_observations: int = MIN_OBSERVATIONS,
) -> dict[str, Any]:
    """Return the fields of a report on a verified file; raises `AnswerIsNo` if it does not act as the policy does."""
    agreement, loop = verify(policy, exported, file, workers, min_observations)
    if not (agreement.agrees and (loop.agrees or loop.magnified)):
        why = f"{what} does not act as {policy.file.path} does"
        if agreement.agrees:
            task = policy.info.spec.task
            why = f"all actions agree, but the episodes differ; is the environment reproducible? rlctl check-env {task}"
        numbers = f"{format_agreement(agreement)}\n{format_closed_loop(loop)}"
        raise AnswerIsNo(f"{target}: not verified, not written: {why}\n{numbers}")
    latency = measure_latency(policy, exported)
    return {**_describe(policy, target), "agreement": agreement, "closed_loop": loop, "latency": latency}
