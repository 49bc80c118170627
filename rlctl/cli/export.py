"""`rlctl export` and `rlctl push`."""

from pathlib import Path
from typing import Annotated

from rlctl.arguments import choose_checkpoint, command
from rlctl.engine import Engine
from rlctl.errors import UsageError
from rlctl.exporting.export_request import DatasetFormat, ExportRequest, Format
from rlctl.options import Argument, Checkpoint, Json, Option, Pretrained, RunName, SimOption


@command
def export(
    run: RunName = None,
    onnx: Annotated[bool, Option("Write an ONNX file (the default without --c).", ("--onnx",))] = False,
    c: Annotated[bool, Option("Write a C99 header and source file without dependencies.", ("--c",))] = False,
    controller: Annotated[
        bool,
        Option(
            "Write the controller, from what a robot measures to joint targets within limits; ONNX and C99.",
            ("--controller",),
        ),
    ] = False,
    limits: Annotated[
        Path | None, Option("Limits of the controller's commands, in its C file (limits.yaml).", metavar="FILE")
    ] = None,
    mapping: Annotated[
        Path | None,
        Option(
            "The program's units and order of inputs and targets (YAML), as rlctl diagnose prints them.", metavar="FILE"
        ),
    ] = None,
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
    sim: SimOption = None,
    output: Annotated[
        Path | None,
        Option(
            "Default: exports/policy.onnx or exports/policy.c in the run's folder.", ("--output", "-o"), metavar="PATH"
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Write a policy, or its controller, as a self-contained ONNX file or C source; verify that it acts the same."""
    checkpoint = choose_checkpoint(checkpoint, pretrained)
    if policy is not None and (output is not None or onnx or c or controller):
        raise UsageError("--policy FILE writes only that file: leave out --output, --onnx, --c and --controller")
    if policy is not None and sim is not None:
        raise UsageError("--policy FILE contains the score in the engine of the training: leave out --sim")
    formats: tuple[Format, ...] = ("c",) if c else ("onnx",)
    if (onnx and c) or (controller and onnx == c):  # of a controller both are the default
        formats = ("onnx", "c")
    request = ExportRequest(
        run,
        formats,
        checkpoint,
        output,
        policy=policy,
        episodes=episodes,
        dataset=dataset,
        controller=controller,
        limits=limits,
        sim=sim or Engine(),
        mapping=mapping,
    )
    if dataset is not None:
        if onnx or c or controller or policy is not None:
            raise UsageError("--dataset writes only a dataset: leave out --onnx, --c, --controller and --policy")
        from rlctl.exporting import dataset as dataset_module

        dataset_module.show(dataset_module.export_dataset(request), json)
        return
    if policy is not None:
        from rlctl.exporting import policy_file

        policy_file.show(policy_file.export_actor(request), json)
        return
    from rlctl.exporting.export import export_policy
    from rlctl.exporting.report import show

    if controller:
        from rlctl.exporting.controller.export import export_controller

        reports = export_controller(request)
    else:
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
