"""`rlctl export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlctl.cli.arguments import Checkpoint, Json, Run, claim_stdout


def export(
    run: Run = None,
    onnx: Annotated[bool, typer.Option("--onnx", help="Write an ONNX file: the only format, so not needed.")] = True,
    checkpoint: Checkpoint = "best",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Default: exports/policy.onnx of the run.", show_default=False
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Turn a policy into a self-contained ONNX file, and verify that it acts the same."""
    claim_stdout()
    from rlctl.export.export import export_onnx
    from rlctl.export.report import show

    show(export_onnx(run, checkpoint=checkpoint, output=output), json)
