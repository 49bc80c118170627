"""`rlctl export` and `rlctl push`."""

from pathlib import Path
from typing import Annotated

from rlctl.cli.arguments import choose_checkpoint, command
from rlctl.errors import UsageError
from rlctl.exporting.request import DatasetFormat, ExportRequest, Format
from rlctl.options import Argument, Checkpoint, Json, Option, Pretrained, RunName, Sim


@command
def export(
    run: RunName = None,
    onnx: Annotated[bool, Option("Write an ONNX file (the default without --c).", ("--onnx",))] = False,
    c: Annotated[bool, Option("Write a C99 header and source file without dependencies.", ("--c",))] = False,
    policy: Annotated[
        Path | None,
        Option(
            "Write only the policy with its measured score, in the form that plugins ship (.safetensors).",
            metavar="FILE",
        ),
    ] = None,
    dataset: Annotated[DatasetFormat | None, Option("Write only a dataset: episodes of the policy.")] = None,
    episodes: Annotated[int, Option("Episodes of the dataset.", min=1)] = 100,
    checkpoint: Checkpoint = "best",
    pretrained: Pretrained = False,
    sim: Sim = None,
    output: Annotated[
        Path | None,
        Option(
            "Default: exports/policy.onnx or exports/policy.c in the run's folder.", ("--output", "-o"), metavar="PATH"
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Write a policy as a self-contained ONNX file or C source, and verify that it acts the same."""
    checkpoint = choose_checkpoint(checkpoint, pretrained)
    if policy is not None and (output is not None or onnx or c):
        raise UsageError("--policy FILE writes only that file: leave out --output, --onnx and --c")
    formats: tuple[Format, ...] = ("onnx", "c") if onnx and c else ("c",) if c else ("onnx",)
    request = ExportRequest(run, formats, checkpoint, output, policy, episodes, dataset, sim)
    if dataset is not None:
        if onnx or c or policy is not None:
            raise UsageError("--dataset writes only a dataset: leave out --onnx, --c and --policy")
        from rlctl.exporting import dataset as dataset_module

        dataset_module.show(dataset_module.export_dataset(request), json)
        return
    if policy is not None:
        from rlctl.exporting import policy_file

        policy_file.show(policy_file.export_actor(request), json)
        return
    from rlctl.exporting.export import export_policy, show

    reports = export_policy(request)
    show(reports, json)
    for report in reports:
        report.check()


@command
def push(
    run: RunName,
    address: Annotated[str, Argument("hf://ORG/NAME, s3://BUCKET/NAME or another scheme of fsspec.")],
    json: Json = None,
) -> None:
    """Upload a run's best policy, recipe, scores, recording and a model card to an address."""
    from rlctl.runs.push import push_run, show

    return show(push_run(run, address), json)
