"""`rlctl export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlctl.cli.arguments import Checkpoint, Json, Pretrained, Run, choose_checkpoint, claim_stdout
from rlctl.errors import UsageError
from rlctl.exporting.request import ExportRequest, Format


def export(
    run: Run = None,
    onnx: Annotated[bool, typer.Option("--onnx", help="Write an ONNX file (the default without --c).")] = False,
    c: Annotated[bool, typer.Option("--c", help="Write a C99 header and source file without dependencies.")] = False,
    policy: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the actor with its measured score instead, as plugins ship it: .safetensors."
        ),
    ] = None,
    checkpoint: Checkpoint = "best",
    pretrained: Pretrained = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Default: exports/policy.onnx, or .c, of the run."),
    ] = None,
    json: Json = None,
) -> None:
    """Write a policy as a self-contained ONNX file or C source, and verify that it acts the same."""
    claim_stdout()
    checkpoint = choose_checkpoint(checkpoint, pretrained)
    if policy is not None and (output is not None or onnx or c):
        raise UsageError("--policy FILE writes only that file: leave out --output, --onnx and --c")
    formats: tuple[Format, ...] = ("onnx", "c") if onnx and c else ("c",) if c else ("onnx",)
    request = ExportRequest(run, formats, checkpoint, output, policy)
    if policy is not None:
        from rlctl.exporting import policy_file

        policy_file.show(policy_file.export_actor(request), json)
        return
    from rlctl.exporting.export import export_policy
    from rlctl.exporting.report import show

    show(export_policy(request), json)
