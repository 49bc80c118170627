"""`rlctl export --controller`: writes a controller as C and ONNX; keeps a file only if it acts as the policy does."""

import dataclasses
import functools
import os
import platform
import tempfile
import timeit
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlctl import output
from rlctl.environments.info import describe
from rlctl.environments.spec import EnvChanges, EnvSpec
from rlctl.errors import TaskError, UsageError
from rlctl.exporting.c_source import FLAGS, find_compiler
from rlctl.exporting.controller import verify
from rlctl.exporting.controller.controllers import (
    CController,
    Controller,
    MappedController,
    OnnxController,
    compile_controller,
)
from rlctl.exporting.controller.example import ROWS, write_example
from rlctl.exporting.controller.graph import build_graph
from rlctl.exporting.controller.plan import ControllerPlan, JointTarget
from rlctl.exporting.controller.program_mapping import NO_MAPPING, ProgramMapping, read_mapping
from rlctl.exporting.controller.source import ControllerSource
from rlctl.exporting.export_request import ExportRequest
from rlctl.exporting.exported_policy import check_environment, explain_unverifiable, find_source
from rlctl.exporting.report import ExportReport, ReportRow, check_verified, describe_policy
from rlctl.exporting.verify import Latency, change_last_bits, measure_sb3
from rlctl.limits.doubts import list_doubts
from rlctl.limits.limits import Limits, read_limits
from rlctl.policy.actor import Actor
from rlctl.policy.file import PolicyFile
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.onnx_policy import encode
from rlctl.policy.torch_policy import TorchActor, pin_threads
from rlctl.storage import files


@dataclasses.dataclass(frozen=True, kw_only=True)
class ControllerReport(ExportReport):
    """A controller that was exported, and how it was verified."""

    max_target_difference: float | None = None

    def list_rows(self) -> list[ReportRow]:
        """Return the lines of the report."""
        details, rows = self.details, self.group_rows()
        inputs, checks, end = rows.inputs, [*rows.checks, *rows.latency], rows.following
        if "opset" in details:  # for a robot's program: `rlctl eval` is not next
            checks, end = rows.checks, rows.latency
        else:
            inputs = [("inputs", ", ".join(f"{name}[{size}]" for name, size in details["input_sizes"].items()))]
        targets = [("target", details["target"])] if details["target"] else []
        mappings = [("mapping", f"{name}: {text}") for name, text in details["mapping"].items()]
        limits = [("limits", details["limits"])]
        if details.get("limits_cost") is not None:
            limits.append(("their cost", str(details["limits_cost"])))
        example: list[ReportRow] = []
        if details["example"]:
            example = [("example", f"{details['example']}: inputs and outputs of {ROWS} steps")]
        return [*rows.file, *inputs, *targets, *mappings, *limits, *rows.interface, *checks, *example, *end]


def export_controller(request: ExportRequest) -> list[ExportReport]:
    """Export a policy's controller in one or more formats, and verify each in the policy's own environment.

    Raises `UsageError` if a policy cannot have a controller, `RecipeError` for limits that do not fit it. Raises
    `AnswerIsNo` with the numbers if a file does not act as the policy does; that file is not written.
    """
    source, target = find_source(request, "controller")
    limits = None if request.limits is None else read_limits(request.limits)
    pin_threads()
    with output.show_progress("loading the policy"):
        torch_actor = TorchActor.load(source.file)
    spec = _choose_spec(source.locate(torch_actor.info.derive_spec(changes=EnvChanges(sim=request.sim))))
    try:
        with output.show_progress("building the environment"):
            env = spec.make()
        built = describe(env)
    except (UsageError, TaskError) as error:
        raise explain_unverifiable(source.file, error) from None
    try:
        check_environment(source.file, torch_actor.info, built)
        # Policies that were trained before their task declared its terms do not contain them.
        policy = torch_actor.file.with_info(env=built)
        plan = ControllerPlan(built, policy.info.spec.frame_stack)
        output.print_notes([] if limits is None else list_doubts(limits, policy.info.env))
        mapping = NO_MAPPING if request.mapping is None else read_mapping(request.mapping, plan)
        export = _Export(torch_actor, policy, plan, verify.TaskPlayer(plan, env, spec.task), limits, mapping)
        write = {"onnx": export.write_onnx, "c": export.write_c}
        return [write[form](target.with_suffix(f".{form}")) for form in request.formats]
    finally:
        env.close()


def _choose_spec(spec: EnvSpec) -> EnvSpec:
    """Return the environment of the verification: without events, because noise acts on computed terms."""
    return dataclasses.replace(spec.as_deployed(), randomize=False, events={})


@dataclasses.dataclass(frozen=True, eq=False)
class _Export:
    """A policy, and what its files are compared with. `policy` has the present description of its environment."""

    torch_actor: TorchActor
    policy: PolicyFile
    plan: ControllerPlan
    player: verify.TaskPlayer
    limits: Limits | None
    mapping: ProgramMapping

    def write_onnx(self, path: Path) -> ControllerReport:
        """Write and verify the ONNX file, which has no limits."""
        model = build_graph(self.policy, self.plan, self.mapping)
        content = encode(model)
        controller = OnnxController(content)
        target = self.plan.target
        fields, recorded = self._verify(path, controller, target, is_limited=False)
        inputs = recorded[0].inputs[0]
        median = float(np.median(timeit.repeat(lambda: controller.step(inputs), number=1, repeat=330)[30:])) * 1e6
        files.write_bytes(path, content)
        example = self._write_example(path, controller, recorded)
        ports = {
            kind: [{"name": port.name, "dtype": port.type[len("tensor(") : -1], "shape": port.shape} for port in some]
            for kind, some in (
                ("inputs", controller.session.get_inputs()),
                ("outputs", controller.session.get_outputs()),
            )
        }
        details = {
            "opset": model.opset_import[0].version,
            **ports,
            "example": example,
            "limits": "none: the limits are in the C file",
        }
        return self._report(path, len(content), details, target, median, fields)

    def write_c(self, path: Path) -> ControllerReport:
        """Write and verify the C file and its header, with the limits."""
        source = ControllerSource(self.policy, self.plan, path.stem, self.limits, self.mapping)
        compiler, median, example = find_compiler(), None, None
        cost = None
        command = os.environ.get("CC") or "cc"
        fields: dict[str, Any] = {"not_verified": f"there is no C compiler {command!r}; set CC to one"}
        code = source.write()
        if compiler is not None:
            with tempfile.TemporaryDirectory(prefix="rlctl-") as folder:
                with output.show_progress("compiling"):
                    library = compile_controller(code, Path(folder), compiler)
                controller = CController(self.plan, library, has_target=source.target is not None)
                fields, recorded = self._verify(path, controller, source.target, is_limited=self.limits is not None)
                if self.limits is not None:
                    cost = verify.measure_limits_cost(self._record(is_limited=False), recorded)
                median, longest = verify.measure_step(controller, recorded)
                example = self._write_example(path, controller, recorded)
            code = source.write(
                f"A step took {median:.1f} us (median; {longest:.1f} us were enough for 99 % of the steps) "
                f"on {platform.machine()} with {Path(compiler[0]).name} {FLAGS[1]}."
            )
        header = path.with_name(f"{code.name}.h")
        files.write_text(header, code.header)
        files.write_text(path, code.source)
        size = len(code.source.encode()) + len(code.header.encode())
        limits = "the bounds of the action; --limits FILE adds others" if self.limits is None else str(self.limits.file)
        details = {"header": header, "prototype": code.prototype, "compiler": (compiler or [""])[0]}
        details |= {"example": example, "limits": limits, "limits_cost": cost}
        return self._report(path, size, details, source.target, median, fields)

    def _write_example(self, path: Path, controller: Controller, recorded: list[verify.Recorded]) -> Path:
        example = path.with_name(f"{path.name}.csv")
        program = MappedController(controller, self.mapping)  # whose values the file has
        files.write_text(example, write_example(controller, [program.undo(inputs) for inputs in recorded[0].inputs]))
        return example

    def _make_reference(self, actor: Actor, is_limited: bool) -> Actor:
        """Return what a controller is compared with: the policy in Python, within the limits."""
        return actor if self.limits is None or not is_limited else self.player.limit(actor, self.limits)

    @functools.lru_cache(maxsize=2)  # noqa: B019 (for one export)
    def _record(self, *, is_limited: bool) -> list[verify.Recorded]:
        return verify.record(self.player, self._make_reference(self.torch_actor, is_limited))

    def _check_conclusive(self, is_limited: bool, different: Sequence[int]) -> tuple[bool, bool]:
        changed = (
            dataclasses.replace(self.policy, tensors=tensors) for tensors in change_last_bits(self.policy.tensors)
        )
        others = (self._make_reference(NumpyActor(policy), is_limited) for policy in changed)
        original = self._make_reference(self.torch_actor, is_limited)
        return verify.check_conclusive(self.player, original, others, self._record(is_limited=is_limited), different)

    def _verify(
        self, path: Path, controller: Controller, target: JointTarget | None, *, is_limited: bool
    ) -> tuple[dict[str, Any], list[verify.Recorded]]:
        """Return how a controller was verified, as fields of its report; raises `AnswerIsNo` if it acts differently."""
        recorded = self._record(is_limited=is_limited)
        result = verify.verify_controller(self.player, recorded, MappedController(controller, self.mapping), target)
        agreement, loop = result.agreement, result.closed_loop
        if agreement.agrees and not loop.agrees:
            repeats, magnified = self._check_conclusive(is_limited, result.different)
            loop = dataclasses.replace(loop, repeats=repeats, magnified=magnified)
        check_verified(path, self.torch_actor.file.path, agreement, loop)
        fields = {"agreement": agreement, "closed_loop": loop, "max_target_difference": result.max_target_difference}
        return fields, recorded

    def _report(
        self,
        path: Path,
        size: int,
        details: dict[str, Any],
        target: JointTarget | None,
        median: float | None,
        fields: dict[str, Any],
    ) -> ControllerReport:
        sizes = {part.name: part.size for part in self.plan.quantities}
        details = {**details, "input_sizes": sizes, "mapping": self.mapping.describe()}
        details["target"] = "" if target is None else target.formula
        if median is not None:
            fields["latency"] = Latency(median, measure_sb3(self.torch_actor))
        return ControllerReport(**describe_policy(self.torch_actor, path), **fields, size=size, details=details)
