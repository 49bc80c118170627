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
    onnx: Annotated[bool, typer.Option("--onnx", help="Write an ONNX file; so without --c as well.")] = False,
    c: Annotated[bool, typer.Option("--c", help="Write a C99 header and source file without dependencies.")] = False,
    policy: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the actor with its measured score instead, as plugins ship it (.safetensors)."
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
    """Turn a policy into a self-contained ONNX file or C source, and verify that it acts the same."""
    claim_stdout()
    checkpoint = choose_checkpoint(checkpoint, pretrained)
    if policy is not None and (output is not None or onnx or c):
        raise UsageError("--policy FILE writes that file and no other: leave out --output, --onnx and --c")
    wanted: dict[Format, bool] = {"onnx": onnx or not c, "c": c}
    formats = tuple(name for name, is_wanted in wanted.items() if is_wanted)
    request = ExportRequest(run, formats, checkpoint, output, policy)
    if policy is not None:
        from rlctl.exporting import policy_file

        policy_file.show(policy_file.export_actor(request), json)
        return
    from rlctl.exporting.export import export_policy
    from rlctl.exporting.report import show

    show(export_policy(request), json)
