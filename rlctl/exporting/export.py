"""`rlctl export`: write a policy as an ONNX file or C source, and keep the file only if it acts as the policy does."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl import output
from rlctl.engine import Engine
from rlctl.environments.spec import EnvChanges
from rlctl.errors import TaskError, UsageError
from rlctl.exporting.export_request import ExportRequest
from rlctl.exporting.exported_policy import check_environment, explain_unverifiable, find_source
from rlctl.exporting.report import ExportReport, check_verified, describe_policy
from rlctl.exporting.verify import EPISODES, measure_latency, verify
from rlctl.hub import store
from rlctl.play.workers import Workers, count_envs
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.load import check_playable
from rlctl.policy.own_modules import KEYS, import_named
from rlctl.runs.lookup import FoundPolicy
from rlctl.storage import files

if TYPE_CHECKING:
    import onnx

    from rlctl.exporting.c_source import CSource
    from rlctl.policy.c_policy import CActor
    from rlctl.policy.onnx_policy import OnnxActor
    from rlctl.policy.torch_policy import TorchActor


def export_policy(request: ExportRequest) -> list[ExportReport]:
    """Export a policy in one or more formats and verify each file in the policy's own environment.

    The files of several formats differ in their suffix. Raises `UsageError` if a format cannot represent the policy.
    Raises `AnswerIsNo` with the numbers if a file does not act as the policy does; that file is not written.
    """
    source, target = find_source(request, "policy")
    return _export(source, [target.with_suffix(f".{name}") for name in request.formats], request.sim)


def _export(source: FoundPolicy, targets: list[Path], sim: Engine) -> list[ExportReport]:
    policy = check_playable(PolicyFile.read(source.file))
    info = policy.info
    has_own = any(isinstance(info.policy_kwargs.get(key), dict) for key in KEYS)
    if source.run is not None and has_own and not store.is_cached(source.run.path):
        # The user's run names the classes. A downloaded run has a recipe that others wrote.
        import_named(source.run.recipe().policy_kwargs)
    # The environments are built while torch is imported.
    n_envs = 1
    spec = source.locate(info.derive_spec(changes=EnvChanges(sim=sim)))
    with contextlib.suppress(UsageError, TaskError):  # `_check_environment` says what does not build
        n_envs = count_envs(spec, EPISODES)
    with Workers(spec, n_envs) as workers:
        from rlctl.exporting.c_source import write_c
        from rlctl.exporting.onnx_source import build
        from rlctl.policy.torch_policy import TorchActor, pin_threads

        with output.show_progress("loading the policy and its environment"):
            pin_threads()
            models = [(target, build(policy)) for target in targets if target.suffix == ".onnx"]
            sources = [(target, write_c(policy, target.stem)) for target in targets if target.suffix == ".c"]
            torch_policy = TorchActor.load(source.file)
            _check_environment(source.file, info, workers)
        reports = [
            *(_export_onnx(torch_policy, workers, target, model) for target, model in models),
            *(_export_c(torch_policy, workers, target, code) for target, code in sources),
        ]
    output.print_notes(
        f"warning: {file} was not written now, and is of another policy than {targets[0].name}; to write both: "
        "rlctl export with --onnx --c"
        for file in _find_others(policy, targets)
    )
    return reports


def _find_others(policy: PolicyFile, targets: list[Path]) -> list[Path]:
    """Return the files in the other format next to exported ones that differ from an export of this policy."""
    from rlctl.exporting.c_source import write_c
    from rlctl.exporting.onnx_source import build
    from rlctl.policy.onnx_policy import encode

    others = []
    for file in {target.with_suffix(suffix) for target in targets for suffix in (".onnx", ".c")} - set(targets):
        if not file.is_file():
            continue
        try:
            equal = encode(build(policy)) if file.suffix == ".onnx" else write_c(policy, file.stem).source.encode()
        except UsageError:  # a format that cannot represent this policy
            equal = b""
        if file.read_bytes() != equal:
            others.append(file)
    return others


def _check_environment(policy_file: Path, info: PolicyInfo, workers: Workers) -> None:
    try:
        built = workers.info
    except (UsageError, TaskError) as error:
        raise explain_unverifiable(policy_file, error) from None
    check_environment(policy_file, info, built)


def _export_onnx(policy: TorchActor, workers: Workers, target: Path, model: onnx.ModelProto) -> ExportReport:
    from rlctl.policy.onnx_policy import OnnxActor, encode

    content = encode(model)
    fields: dict[str, Any] = {}

    def write(part: Path) -> None:
        part.write_bytes(content)
        exported = OnnxActor.load(part)
        ports = {"inputs": exported.session.get_inputs(), "outputs": exported.session.get_outputs()}
        fields["details"] = {"opset": model.opset_import[0].version} | {
            kind: [{"name": port.name, "dtype": port.type[len("tensor(") : -1], "shape": port.shape} for port in some]
            for kind, some in ports.items()
        }
        fields.update(_verify(policy, workers, target, exported, part))

    files.write_with(target, write)
    return ExportReport(**describe_policy(policy, target), **fields, size=len(content))


def _export_c(policy: TorchActor, workers: Workers, target: Path, code: CSource) -> ExportReport:
    from rlctl.exporting.c_source import build_library, find_compiler
    from rlctl.policy.c_policy import CActor

    compiler = find_compiler()
    # The source includes the header by the identifier: policy-1.c includes policy_1.h.
    header = target.with_name(f"{code.name}.h")
    command = os.environ.get("CC") or "cc"
    fields: dict[str, Any] = {"not_verified": f"there is no C compiler {command!r}; set CC to one"}
    if compiler is not None:
        with tempfile.TemporaryDirectory(prefix="rlctl-") as folder:
            with output.show_progress("compiling"):
                library = build_library(code, policy.info, Path(folder), compiler)
            fields = _verify(policy, workers, target, CActor.load(library), library)
    files.write_text(header, code.header)
    files.write_text(target, code.source)
    size = len(code.source.encode()) + len(code.header.encode())
    details = {"header": header, "prototype": code.prototype, "compiler": (compiler or [""])[0]}
    return ExportReport(**describe_policy(policy, target), **fields, size=size, details=details)


def _verify(
    policy: TorchActor, workers: Workers, target: Path, exported: OnnxActor | CActor, file: Path
) -> dict[str, Any]:
    """Return how a file was verified, as fields of its report; raises `AnswerIsNo` if it acts differently."""
    agreement, loop = verify(policy, exported, file, workers)
    check_verified(target, policy.file.path, agreement, loop)
    return {"agreement": agreement, "closed_loop": loop, "latency": measure_latency(policy, exported)}
