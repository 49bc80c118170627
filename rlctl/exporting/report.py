"""The report of an export: what was written, how it was verified, and an error for a file that acts otherwise."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl import output
from rlctl.errors import AnswerIsNo
from rlctl.exporting.verify import MAX_DIFFERENCE, Agreement, ClosedLoop, Latency

if TYPE_CHECKING:
    from rlctl.policy.torch_policy import TorchActor


ReportRow = tuple[str, str]  # a word and a text


@dataclasses.dataclass(frozen=True)
class ReportRows:
    """The lines of a report, in groups."""

    file: list[ReportRow]  # what was written, and from which policy
    inputs: list[ReportRow]
    interface: list[ReportRow]  # the other side: outputs, or the function in C
    checks: list[ReportRow]
    latency: list[ReportRow]
    following: list[ReportRow]  # the command that comes next


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

    def list_rows(self) -> list[ReportRow]:
        """Return the lines of the report."""
        rows = self.group_rows()
        return [*rows.file, *rows.inputs, *rows.interface, *rows.checks, *rows.latency, *rows.following]

    def group_rows(self) -> ReportRows:
        """Return the lines of the report in groups."""
        details, size = self.details, f"{self.size / 1000:,.1f} kB"
        inputs: list[ReportRow] = []
        if "opset" in details:
            exported, following = f"{self.path} ({size}, opset {details['opset']})", ["rlctl", "eval", str(self.path)]
            following += ["--task", self.task]
            inputs = [("inputs", _format_ports(details["inputs"]))]
            interface = [("outputs", _format_ports(details["outputs"]))]
        else:
            exported, following = f"{self.path} and {details['header'].name} ({size}, C99)", ["cc", "-std=c99"]
            following += ["-O3", "-c", str(self.path)]
            interface = [("function", details["prototype"])]
        policy = f"{self.algo} for {self.task}, {self.training_steps:,} steps, from {self.policy}"
        checks, latencies = [("not verified", self.not_verified)], []
        if self.agreement and self.closed_loop and (latency := self.latency):
            times = f"{latency.exported_us:.1f} us for one observation; SB3 {latency.sb3_us:.1f} us"
            checks = [
                ("verified", format_agreement(self.agreement)),
                ("closed loop", format_closed_loop(self.closed_loop)),
            ]
            latencies = [("latency", f"{times}, {latency.speedup:.1f}x")]
        return ReportRows(
            file=[("exported", exported), ("policy", policy)],
            inputs=inputs,
            interface=interface,
            checks=checks,
            latency=latencies,
            following=[("next", shlex.join(following))],
        )


def _format_ports(ports: Sequence[Mapping[str, Any]]) -> str:
    return ", ".join(f"{port['name']} {port['dtype']}[{', '.join(map(str, port['shape']))}]" for port in ports)


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
