"""`rlctl identify`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rlctl.arguments import command, parse_changes
from rlctl.errors import UsageError
from rlctl.options import TASK_FORMS, Argument, Json, Option, Settings, SimOption

if TYPE_CHECKING:
    from rlctl.environments.spec import EnvSpec


@command
def identify(
    task: Annotated[
        str,
        Argument(
            f"The model file of a robot (.xml, .urdf), or a task. {TASK_FORMS}", metavar="ROBOT|TASK", completes="task"
        ),
    ],
    log: Annotated[
        Path | None,
        Option(
            "Recording of the robot (.csv). Of a model file: time, target_JOINT, position_JOINT; of a task: time, "
            "action_..., position_JOINT, velocity_JOINT. A row per command.",
            metavar="FILE",
        ),
    ] = None,
    excite: Annotated[
        Path | None, Option("Read no log; write a safe trajectory to play and log.", metavar="FILE")
    ] = None,
    fit: Annotated[
        list[str],
        Option(
            "Of a model file: estimate this quantity only (stiffness, armature, viscous, coulomb, bias, delay, "
            "torque, backlash, mass); repeatable. Default: all but the last three.",
            ("--fit",),
            metavar="NAME",
        ),
    ] = [],
    columns: Annotated[
        Path | None,
        Option("Of a model file: columns of the log, their scale and offset (YAML), as of diagnose.", metavar="FILE"),
    ] = None,
    timestep: Annotated[
        float | None,
        Option(
            "Of a model file: physics step in seconds, that of your task. Default: the file's, of a URDF 0.004.",
            min=0.0005,
            max=0.005,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        Option(
            "Of a model file: write the robot as MJCF and its values for set_motors.",
            ("--output", "-o"),
            metavar="FOLDER",
        ),
    ] = None,
    rate: Annotated[float, Option("Of a model file: rows per second of --excite.", min=5.0, max=2000.0)] = 50.0,
    events: Annotated[
        list[str], Option("Estimate the values of this event only; repeatable.", ("--event",), metavar="NAME")
    ] = [],
    seconds: Annotated[
        float | None,
        Option(
            "Length of the trajectory of --excite, in seconds.",
            min=1.0,
            max=3600.0,
            default_text="10, of a model file 60",
        ),
    ] = None,
    settings: Settings = [],
    sim: SimOption = None,
    seed: Annotated[int, Option("Seed of the search, or of the trajectory.", min=0)] = 0,
    json: Json = None,
) -> None:
    """Estimate the physical values with which the simulation follows a log of the robot."""
    from rlctl_robot.identify.robot_model import is_model_file

    if (log is None) == (excite is None):
        raise UsageError("give either --excite FILE or --log FILE")
    if not is_model_file(task):
        _refuse(
            {"--fit": fit, "--columns": columns, "--timestep": timestep, "--output": output},
            "a robot's model file (.xml, .urdf)",
        )
        from rlctl.recipe.recipe_files import make_spec

        spec = parse_changes(settings, sim).apply(make_spec(task))
        _identify_task(spec, log, excite, events, seconds or 10.0, seed, json)
        return
    _refuse({"--event": events, "--set": settings, "--sim": sim}, "a task")
    if excite is not None:
        from rlctl_robot.identify.robot_excite import show_robot_excitation, write_robot_excitation

        _refuse({"--fit": fit, "--columns": columns, "--timestep": timestep, "--output": output}, "--log")
        found = write_robot_excitation(task, excite, seconds=seconds or 60.0, rate=rate, seed=seed)
        show_robot_excitation(found, json)
        return
    assert log is not None
    _identify_robot(task, log, fit, columns, timestep, output, json)


def _refuse(options: dict[str, object], needed: str) -> None:
    """Raise `UsageError` for a given option that is for something else."""
    for name, value in options.items():
        if value:
            raise UsageError(f"{name} is for {needed}")


def _identify_robot(
    file: str,
    log: Path,
    fit: list[str],
    columns: Path | None,
    timestep: float | None,
    folder: Path | None,
    json: str | None,
) -> None:
    from rlctl import output
    from rlctl_robot.identify.robot import identify_robot
    from rlctl_robot.identify.robot_report import show_robot, write_robot

    result = identify_robot(
        file,
        log,
        columns=columns,
        fit=fit,
        timestep=timestep,
        report=lambda line: output.err().print(f"identify: {line}"),
    )
    output.print_notes(result.notes)
    written = [] if folder is None else write_robot(result, folder)
    show_robot(result, written, json)


def _identify_task(
    spec: "EnvSpec",
    log: Path | None,
    excite: Path | None,
    events: list[str],
    seconds: float,
    seed: int,
    json: str | None,
) -> None:
    from rlctl import output
    from rlctl_robot.identify.excite import show_excitation, write_excitation
    from rlctl_robot.identify.identify import identify, show

    if excite is not None:
        show_excitation(write_excitation(spec, excite, seconds=seconds, seed=seed), json)
        return
    assert log is not None
    result = identify(spec, log, events=events, seed=seed, report=lambda line: output.err().print(f"identify: {line}"))
    show(result, json)
