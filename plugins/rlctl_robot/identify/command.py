"""`rlctl identify`."""

from pathlib import Path
from typing import Annotated

from rlctl.arguments import command, parse_changes
from rlctl.errors import UsageError
from rlctl.options import Json, Option, Settings, SimOption, TaskName


@command
def identify(
    task: TaskName,
    log: Annotated[
        Path | None,
        Option(
            "Recording of the robot (CSV): time, action_..., position_JOINT, velocity_JOINT; a row per action.",
            metavar="FILE",
        ),
    ] = None,
    excite: Annotated[
        Path | None, Option("Read no log; write a safe trajectory to play and log.", metavar="FILE")
    ] = None,
    events: Annotated[
        list[str], Option("Estimate the values of this event only; repeatable.", ("--event",), metavar="NAME")
    ] = [],
    seconds: Annotated[float, Option("Length of the trajectory of --excite, in seconds.", min=1.0, max=3600.0)] = 10.0,
    settings: Settings = [],
    sim: SimOption = None,
    seed: Annotated[int, Option("Seed of the search, or of the trajectory.", min=0)] = 0,
    json: Json = None,
) -> None:
    """Estimate the physical values with which the simulation follows a log of the robot."""
    from rlctl import output
    from rlctl.recipe.sources import make_spec
    from rlctl_robot.identify.excite import show_excitation, write_excitation
    from rlctl_robot.identify.identify import identify, show

    spec = parse_changes(settings, sim).apply(make_spec(task))
    if excite is not None and log is None:
        show_excitation(write_excitation(spec, excite, seconds=seconds, seed=seed), json)
        return
    if log is None or excite is not None:
        raise UsageError("give either --excite FILE or --log FILE")
    result = identify(spec, log, events=events, seed=seed, report=lambda line: output.err().print(f"identify: {line}"))
    show(result, json)
