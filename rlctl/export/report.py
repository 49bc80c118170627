"""What an export reports: the file, how it was verified, what goes in and comes out."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.export.agreement import MAX_DIFFERENCE, Agreement
from rlctl.export.latency import Latency
from rlctl.export.verify import ClosedLoop


@dataclasses.dataclass(frozen=True)
class Port:
    """An input or output of the graph."""

    name: str
    dtype: str
    shape: tuple[int | str, ...]

    def __str__(self) -> str:
        return f"{self.name} {self.dtype}[{', '.join(str(size) for size in self.shape)}]"


@dataclasses.dataclass(frozen=True)
class ExportReport:
    """A verified ONNX file."""

    path: Path
    policy: Path
    task: str
    algo: str
    training_steps: int
    size: int
    """[bytes]"""
    opset: int
    inputs: list[Port]
    outputs: list[Port]
    agreement: Agreement
    closed_loop: ClosedLoop
    latency: Latency

    def as_json(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            **dataclasses.asdict(self),
            "path": str(self.path),
            "policy": str(self.policy),
            "verified": True,
            "max_difference": self.agreement.max_difference,
            "observations": self.agreement.observations,
            "latency": {**dataclasses.asdict(self.latency), "speedup": self.latency.speedup},
        }


def show(report: ExportReport, json: str | None) -> None:
    """Print a report, or write it as JSON to a file or, for `-`, to stdout."""
    if json is not None:
        output.write_result_json(json, report.as_json())
    if json == "-":
        return
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, text in _list_rows(report):
        table.add_row(name, Text(text))
    output.out().print(table)


def _list_rows(report: ExportReport) -> list[tuple[str, str]]:
    latency = report.latency
    return [
        ("exported", f"{report.path} ({report.size / 1000:,.1f} kB, opset {report.opset})"),
        ("policy", f"{report.algo} for {report.task}, {report.training_steps:,} steps, from {report.policy}"),
        ("inputs", ", ".join(map(str, report.inputs))),
        ("outputs", ", ".join(map(str, report.outputs))),
        ("verified", format_agreement(report.agreement)),
        ("closed loop", format_closed_loop(report.closed_loop)),
        (
            "latency",
            f"{latency.onnx_us:.1f} us for one observation; SB3 {latency.sb3_us:.1f} us, {latency.speedup:.1f}x",
        ),
        ("next", f"rlctl eval {report.path} --task {report.task}"),
    ]


def format_agreement(agreement: Agreement) -> str:
    """Return the comparison on observations, in a line."""
    sizes = " and ".join(str(size) for size in agreement.batch_sizes)
    text = (
        f"max |difference| {agreement.max_difference:.1e} (limit {MAX_DIFFERENCE:.0e}) "
        f"on {agreement.observations:,} observations, batches of {sizes}"
    )
    if agreement.beyond_limit:
        text += f"; {agreement.beyond_limit:,} actions beyond the limit"
    if agreement.near_ties:
        text += f"; {agreement.near_ties:,} near-ties chosen differently"
    return text


def format_closed_loop(loop: ClosedLoop) -> str:
    """Return the comparison of whole episodes, in a line."""
    return (
        f"{loop.episodes} episodes: success same in {loop.same_success}, length in {loop.same_length}, "
        f"return within {loop.max_return_difference:.1e} "
        f"(mean {loop.mean_return:.5g} and {loop.mean_return_onnx:.5g})"
    )
