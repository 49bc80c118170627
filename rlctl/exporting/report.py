"""The report of an export: the file, its inputs and outputs, and how it was verified."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.exporting.verify import MAX_DIFFERENCE, Agreement, ClosedLoop, Latency


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExportReport:
    """A file that was exported, and how it was verified."""

    path: Path
    policy: Path
    task: str
    algo: str
    training_steps: int
    size: int  # [bytes]
    written: str  # text on the written files
    interface: list[tuple[str, str]]  # inputs and outputs: pairs of a word and a text
    next: str  # a command to continue with
    details: Mapping[str, Any]  # JSON entries that only this format has
    agreement: Agreement | None = None
    closed_loop: ClosedLoop | None = None
    latency: Latency | None = None
    not_verified: str = ""  # why it was not verified; empty if it was

    def as_json(self) -> dict[str, Any]:
        """Return the report as plain data."""
        result = {**dataclasses.asdict(self), **self.details, "verified": not self.not_verified}
        for name in ("written", "interface", "next", "details"):
            del result[name]
        if self.agreement and self.latency:
            result |= {name: getattr(self.agreement, name) for name in ("max_difference", "observations")}
            result["latency"]["speedup"] = self.latency.speedup
        return result

    def list_rows(self) -> list[tuple[str, str]]:
        """Return the lines of the report: pairs of a word and a text."""
        policy = f"{self.algo} for {self.task}, {self.training_steps:,} steps, from {self.policy}"
        rows = [("exported", self.written), ("policy", policy), *self.interface]
        if self.not_verified or not (self.agreement and self.closed_loop and self.latency):
            return [*rows, ("not verified", self.not_verified), ("next", self.next)]
        latency = self.latency
        times = f"{latency.exported_us:.1f} us for one observation; SB3 {latency.sb3_us:.1f} us, {latency.speedup:.1f}x"
        return [
            *rows,
            ("verified", format_agreement(self.agreement)),
            ("closed loop", format_closed_loop(self.closed_loop)),
            ("latency", times),
            ("next", self.next),
        ]


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
    success = "" if loop.same_success is None else f"same success in {loop.same_success}, "
    length = f"same length in {loop.same_length}"
    text = (
        f"{episodes}: {success}{length}, return within {loop.max_return_difference:.1e} "
        f"(mean {loop.mean_return:.5g} and {loop.mean_return_exported:.5g})"
    )
    if loop.magnified:
        text += "; the episodes are chaotic: a change in the last bits makes the original policy differ as much"
    return text
