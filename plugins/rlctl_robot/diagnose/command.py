"""`rlctl diagnose`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rlctl.arguments import choose_checkpoint, command
from rlctl.errors import ArtifactError, UsageError
from rlctl.options import Argument, Json, SimOption
from rlctl_robot.diagnose.diagnose_request import DiagnoseRequest

if TYPE_CHECKING:
    from rlctl_robot.diagnose.source import PolicyOrigin


@command
def diagnose(
    request: DiagnoseRequest,
    log: Annotated[
        Path | None,
        Argument(
            "Observations and actions, a row per action: .csv or .npz with columns NAME_0, .., action_0, .., what "
            "`rlctl serve --rerun` wrote, or the folder of a LeRobot dataset. Without it: an imported policy is played "
            "with changes of its mapping.",
            metavar="[LOG]",
            default_text="",
        ),
    ] = None,
    sim: SimOption = None,
    json: Json = None,
) -> None:
    """Find what is wrong between a robot and a policy: order, sign, unit, offset, delay, frozen sensors."""
    from rlctl import output
    from rlctl.arguments import parse_changes
    from rlctl_robot.diagnose.diagnose import diagnose_log
    from rlctl_robot.diagnose.report import show, write_mapping
    from rlctl_robot.diagnose.source import find_source

    if log is not None and not log.exists():
        raise ArtifactError(f"{log}: no such file or folder")
    source = find_source(
        request.policy, choose_checkpoint(request.checkpoint, request.pretrained), parse_changes([], sim)
    )
    output.print_notes(source.notes)
    if log is None:
        if request.output is not None:
            raise UsageError("--output: there is no log, and so no mapping of a program to correct: leave it out")
        _diagnose_deployment(source, request.seed, json)
        return
    result = diagnose_log(
        log,
        source.policy,
        source.spec,  # as trained: its short episodes start anywhere in a clip, as the rows of a log are
        columns=request.columns,
        limits=request.limits,
        seed=request.seed,
        others=source.others,
        report=lambda line: output.err().print(f"diagnose: {line}"),
    )
    output.print_notes(result.notes)
    show(result, json)
    if request.output is not None:
        write_mapping(result, request.output)
    result.check()


def _diagnose_deployment(source: "PolicyOrigin", seed: int, json: str | None) -> None:
    from rlctl import output
    from rlctl_robot.diagnose.deployed import diagnose_deployment, show

    result = diagnose_deployment(
        source.policy, source.spec.as_deployed(), seed, report=lambda line: output.err().print(f"diagnose: {line}")
    )
    show(result, json)
    result.check()
