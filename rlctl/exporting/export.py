"""`rlctl export`: write a policy as an ONNX file or C source, and keep the file only if it acts as the policy does."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shlex
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl import output
from rlctl.engine import Engine
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvChanges
from rlctl.errors import AnswerIsNo, ArtifactError, TaskError, UsageError
from rlctl.exporting.export_request import ExportRequest
from rlctl.exporting.verify import EPISODES, MAX_DIFFERENCE, Agreement, ClosedLoop, Latency, measure_latency, verify
from rlctl.hub import store
from rlctl.play.workers import Workers, count_envs
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.load import check_playable
from rlctl.policy.own_modules import KEYS, import_named
from rlctl.policy.shipped import PRETRAINED
from rlctl.runs import lookup
from rlctl.runs.directory import refuse_links_out
from rlctl.runs.lookup import FoundPolicy
from rlctl.storage import files

if TYPE_CHECKING:
    import onnx

    from rlctl.exporting.c_source import CSource
    from rlctl.policy.c_policy import CActor
    from rlctl.policy.onnx_policy import OnnxActor
    from rlctl.policy.torch_policy import TorchActor


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExportReport:
    """A file that was exported, and how it was verified."""

    path: Path
    policy: Path
    task: str
    algo: str
    training_steps: int
    size: int  # [bytes]
    details: Mapping[str, Any]  # JSON entries that only this format has
    agreement: Agreement | None = None
    closed_loop: ClosedLoop | None = None
    latency: Latency | None = None
    not_verified: str = ""  # why it was not verified; empty if it was

    def as_json(self) -> dict[str, Any]:
        """Return the report as plain data."""
        result = {**dataclasses.asdict(self), **self.details, "verified": not self.not_verified}
        del result["details"]
        if self.agreement and self.latency:
            result |= {name: getattr(self.agreement, name) for name in ("max_difference", "observations")}
            result["latency"]["speedup"] = self.latency.speedup
        return result

    def check(self) -> None:
        """Raise `AnswerIsNo` if the file was not verified."""
        if self.not_verified:
            raise AnswerIsNo(f"{self.path}: not verified: {self.not_verified}")

    def list_rows(self) -> list[tuple[str, str]]:
        """Return the lines of the report: pairs of a word and a text."""
        details, size = self.details, f"{self.size / 1000:,.1f} kB"
        if "opset" in details:
            exported, following = f"{self.path} ({size}, opset {details['opset']})", ["rlctl", "eval", str(self.path)]
            following += ["--task", self.task]
            interface = [(kind, ", ".join(map(_format_port, details[kind]))) for kind in ("inputs", "outputs")]
        else:
            exported, following = f"{self.path} and {details['header'].name} ({size}, C99)", ["cc", "-std=c99"]
            following += ["-O3", "-c", str(self.path)]
            interface = [("function", details["prototype"])]
        policy = f"{self.algo} for {self.task}, {self.training_steps:,} steps, from {self.policy}"
        verification = [("not verified", self.not_verified)]
        if self.agreement and self.closed_loop and (latency := self.latency):
            times = f"{latency.exported_us:.1f} us for one observation; SB3 {latency.sb3_us:.1f} us"
            verification = [
                ("verified", format_agreement(self.agreement)),
                ("closed loop", format_closed_loop(self.closed_loop)),
                ("latency", f"{times}, {latency.speedup:.1f}x"),
            ]
        return [("exported", exported), ("policy", policy), *interface, *verification, ("next", shlex.join(following))]


def _format_port(port: Mapping[str, Any]) -> str:
    return f"{port['name']} {port['dtype']}[{', '.join(map(str, port['shape']))}]"


def show(reports: list[ExportReport], json: str | None) -> None:
    """Print the reports of one policy, or write them as JSON to a file or, for `-`, to stdout.

    The JSON of one report is an object. Several reports are an object with an entry per format, `onnx` and `c`.
    """
    by_format = {report.path.suffix[1:]: report.as_json() for report in reports}
    if output.present(by_format if len(reports) > 1 else reports[0].as_json(), json):
        return
    from rich.text import Text

    for number, report in enumerate(reports):
        if number:
            output.out().print()
        rows = [(Text(name, style="bold"), text) for name, text in report.list_rows()]
        output.print_table(("", ""), rows, left=("",))


def format_agreement(agreement: Agreement) -> str:
    """Return the comparison on observations as one line."""
    sizes = " and ".join(str(size) for size in agreement.batch_sizes)
    text = (
        f"max |difference| {agreement.max_difference:.1e} (limit {MAX_DIFFERENCE:.0e}) "
        f"on {agreement.observations:,} observations, batches of {sizes}"
    )
    if agreement.beyond_limit:
        text += f"; {agreement.beyond_limit:,} actions beyond the limit"
    if agreement.near_ties:
        text += f"; {agreement.near_ties:,} different choices between nearly equal logits"
    return text


def format_closed_loop(loop: ClosedLoop) -> str:
    """Return the comparison of whole episodes as one line."""
    episodes = output.format_count(loop.episodes, "episode")
    if not loop.repeats:
        return "cannot be compared: the environment does not repeat its own episodes (check-env)"
    success = "" if loop.same_success is None else f"same success in {loop.same_success}, "
    text = (
        f"{episodes}: {success}same length in {loop.same_length}, return within {loop.max_return_difference:.1e} "
        f"(mean {loop.mean_return:.5g} and {loop.mean_return_exported:.5g})"
    )
    if loop.magnified:
        text += "; the episodes are chaotic: a change in the last bits makes the original policy differ as much"
    return text


def export_policy(request: ExportRequest) -> list[ExportReport]:
    """Export a policy in one or more formats and verify each file in the policy's own environment.

    The files of several formats differ in their suffix. Raises `UsageError` if a format cannot represent the policy.
    Raises `AnswerIsNo` with the numbers if a file does not act as the policy does; that file is not written.
    """
    source, target = find_source(request, "policy")
    return _export(source, [target.with_suffix(f".{name}") for name in request.formats], request.sim)


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
        return [
            *(_export_onnx(torch_policy, workers, target, model) for target, model in models),
            *(_export_c(torch_policy, workers, target, code) for target, code in sources),
        ]


def _check_environment(policy_file: Path, info: PolicyInfo, workers: Workers) -> None:
    try:
        built = workers.info
    except (UsageError, TaskError) as error:
        raise explain_unverifiable(policy_file, error) from None
    check_environment(policy_file, info, built)


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


def describe_policy(policy: TorchActor, target: Path) -> dict[str, Any]:
    """Return the fields of a report that describe the policy and the file."""
    info = policy.info
    about = {"task": info.spec.task, "algo": info.algo, "training_steps": info.training_steps}
    return {"path": target, "policy": policy.file.path, **about}


def check_verified(path: Path, policy: Path | None, agreement: Agreement, loop: ClosedLoop) -> None:
    """Raise `AnswerIsNo` for a file at `path` that acts otherwise than the policy."""
    if agreement.agrees and (loop.agrees or not loop.is_conclusive):
        return
    why = f"it does not act as {policy} does"
    if agreement.agrees:
        why = "all actions agree, but the episodes differ"
    numbers = f"{format_agreement(agreement)}\n{format_closed_loop(loop)}"
    raise AnswerIsNo(f"{path}: not verified, not written: {why}\n{numbers}")


def _verify(
    policy: TorchActor, workers: Workers, target: Path, exported: OnnxActor | CActor, file: Path
) -> dict[str, Any]:
    """Return how a file was verified, as fields of its report; raises `AnswerIsNo` if it acts differently."""
    agreement, loop = verify(policy, exported, file, workers)
    check_verified(target, policy.file.path, agreement, loop)
    return {"agreement": agreement, "closed_loop": loop, "latency": measure_latency(policy, exported)}
