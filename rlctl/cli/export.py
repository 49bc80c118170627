"""`rlctl export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlctl.cli.arguments import Checkpoint, Json, Run, claim_stdout


def export(
    run: Run = None,
    onnx: Annotated[bool, typer.Option("--onnx", help="Write an ONNX file; so without --c as well.")] = False,
    c: Annotated[bool, typer.Option("--c", help="Write a C99 header and source file without dependencies.")] = False,
    checkpoint: Checkpoint = "best",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Default: exports/policy.onnx, or .c, of the run.",
            show_default=False,
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Turn a policy into a self-contained ONNX file or C source, and verify that it acts the same."""
    claim_stdout()
    from rlctl.export.export import Format, export_policy
    from rlctl.export.report import show

    wanted: dict[Format, bool] = {"onnx": onnx or not c, "c": c}
    formats = [name for name, is_wanted in wanted.items() if is_wanted]
    show(export_policy(run, formats, checkpoint=checkpoint, output=output), json)
