"""`rlctl export`: a policy file becomes an ONNX file, which is kept only if it acts the same."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl.errors import AnswerIsNo, ArtifactError, TaskError, UsageError
from rlctl.export.report import ExportReport, Port, format_agreement, format_closed_loop
from rlctl.output import print_notes
from rlctl.rollout.workers import Workers, available_cores
from rlctl.run import files, lookup, onnx_file
from rlctl.run.lookup import FoundPolicy
from rlctl.run.policy import PolicyInfo, read_policy

if TYPE_CHECKING:
    import onnx

    from rlctl.export.verify import PolicyFiles, Verification


def export_onnx(run: str | None, *, checkpoint: str, output: Path | None) -> ExportReport:
    """Export a policy to ONNX and verify it in its own environment.

    `run` is what the user typed: a run, a policy file, or None for the latest run. The file is written to `output`,
    by default into the run's folder, or beside a policy file that belongs to none. Raises `UsageError` for a policy
    that cannot be written as ONNX, and `AnswerIsNo` with the numbers if the file does not act as the policy does;
    then no file is left.
    """
    found = lookup.find_policy(run, checkpoint)
    print_notes(found.notes)
    policy_file, owner = found.file, found.run
    if policy_file.suffix == ".onnx":
        raise UsageError(f"{policy_file}: an ONNX file already; export the run or its .safetensors file")
    if output is None:
        output = owner.onnx_file if owner else policy_file.with_suffix(".onnx")
    if output.suffix != ".onnx":
        raise UsageError(f"--output {output}: the name of an ONNX file ends in .onnx")
    return _export(found, output)


def _export(found: FoundPolicy, target: Path) -> ExportReport:
    policy_file = found.file
    info, tensors = read_policy(policy_file)
    # The environments are built while torch is imported.
    with Workers(found.locate(info.spec), available_cores()) as workers:
        from rlctl.export.actor import build
        from rlctl.export.verify import PolicyFiles
        from rlctl.run.torch_policy import TorchPolicy, pin_threads

        pin_threads()
        policy = TorchPolicy.load(policy_file)
        model = build(info, policy.network, tensors)
        _check_environment(policy_file, info, workers)
        reports: list[ExportReport] = []

        def write(part: Path) -> None:
            part.write_bytes(onnx_file.encode(model))
            reports.append(_verify(policy_file, target, PolicyFiles(tensors, part), policy, model, workers))

        files.write_with(target, write)
    return reports[0]


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


def _verify(
    policy_file: Path, target: Path, played: PolicyFiles, policy: Any, model: onnx.ModelProto, workers: Workers
) -> ExportReport:
    from rlctl.export.latency import measure
    from rlctl.export.verify import verify
    from rlctl.run.onnx_policy import OnnxPolicy

    exported = OnnxPolicy.load(played.onnx)
    seen = verify(policy, exported, played, workers)
    if not seen.passed:
        raise AnswerIsNo(_explain_failure(policy_file, target, policy.info.spec.task, seen))
    info = policy.info
    return ExportReport(
        path=target,
        policy=policy_file,
        task=info.spec.task,
        algo=info.algo,
        training_steps=info.training_steps,
        size=played.onnx.stat().st_size,
        opset=model.opset_import[0].version,
        inputs=_list_ports(exported.session.get_inputs()),
        outputs=_list_ports(exported.session.get_outputs()),
        agreement=seen.agreement,
        closed_loop=seen.closed_loop,
        latency=measure(policy, exported),
    )


def _explain_failure(policy_file: Path, target: Path, task: str, seen: Verification) -> str:
    why = f"the ONNX file does not act as {policy_file} does"
    if seen.agreement.agrees:
        why = (
            "every action agrees, but the episodes do not: the environment is not reproducible, or magnifies "
            f"differences of {seen.agreement.max_difference:.0e}; see rlctl check-env {task}"
        )
    numbers = f"{format_agreement(seen.agreement)}\n{format_closed_loop(seen.closed_loop)}"
    return f"{target}: not verified, not kept: {why}\n{numbers}"


def _list_ports(found: Any) -> list[Port]:
    return [Port(each.name, each.type[len("tensor(") : -1], tuple(each.shape)) for each in found]
