"""`rlctl serve`, `rlctl robot`, `rlctl play` and `rlctl identify`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from rlctl.cli.arguments import choose_checkpoint, command, command_in_panels, parse_changes
from rlctl.deploy.robot.request import RobotRequest
from rlctl.deploy.server.request import ServeRequest
from rlctl.errors import UsageError
from rlctl.evaluation.request import Gates, MinReturn, MinSuccess, MinSuccessLower
from rlctl.options import Checkpoint, Json, Option, Pretrained, RunName, Settings, Sim, TaskName
from rlctl.playing.request import PlayRequest


@command
def serve(
    request: ServeRequest,
    run: RunName = None,
    checkpoint: Checkpoint = "best",
    pretrained: Pretrained = False,
    self_test: Annotated[
        bool, Option("Play the task through the server in simulation, and print the scores.", ("--self-test",))
    ] = False,
    episodes: Annotated[int, Option("Episodes of the self-test.", min=1, max=1_000_000)] = 100,
    sim: Sim = None,
    json: Json = None,
) -> None:
    """Serve a policy to robots: WebSocket and HTTP, with limits, watchdog, log and a live page."""
    from rlctl import output
    from rlctl.deploy.server.serve import make_server, run_server
    from rlctl.run.lookup import find_policy

    if sim is not None and not self_test:
        raise UsageError("--sim: only the self-test simulates; add --self-test")
    policy = find_policy(run, choose_checkpoint(checkpoint, pretrained))
    output.print_notes(policy.notes)
    if request.limits is None:
        output.print_notes(["warning: no --limits FILE: only the policy's own bounds of actions limit the robot"])
    if self_test:
        # First: it explains a missing package, which the self-test imports.
        server = make_server(policy.file, dataclasses.replace(request, port=0, watchdog=False))
        from rlctl.evaluation import self_test as test
        from rlctl.evaluation.request import EvalRequest

        result = test.run_self_test(
            server,
            EvalRequest(str(policy.file), episodes=episodes, limits=request.limits, changes=parse_changes([], sim)),
        )
        test.show(result, json)
        return result.check()

    def show(address: str) -> None:
        out = output.out()
        out.print(f"{policy.file}: serving at ws://{address}, live page at http://{address}/")
        out.file.flush()

    return run_server(make_server(policy.file, request), show)


@command_in_panels(
    {
        "Options": ["policy", "pretrained", "controller", "episodes", "seed", "realtime", "fault", "settings", "sim"],
        "Gates": ["min_success", "min_success_lower", "min_return"],
        "Where": ["host", "port", "key_file", "timeout_s"],
        "Output": ["json"],
    }
)
def robot(
    request: RobotRequest,
    pretrained: Pretrained = False,
    settings: Settings = [],
    sim: Sim = None,
    min_success: MinSuccess = None,
    min_success_lower: MinSuccessLower = None,
    min_return: MinReturn = None,
    json: Json = None,
) -> None:
    """Play the robot: a program connects by WebSocket or UDP, gets observations and sends commands."""
    from rlctl import output
    from rlctl.deploy.robot.report import show
    from rlctl.deploy.robot.robot import run_robot

    gates = Gates(min_success, min_success_lower, min_return)
    report = run_robot(
        request,
        lambda addresses: output.print_notes([f"waiting for a program at {' or '.join(addresses)}"]),
        pretrained=pretrained,
        changes=parse_changes(settings, sim),
        gates=gates,
    )
    show(report, json, gates)
    return report.check(gates)


@command_in_panels(
    {
        "Options": ["checkpoint", "pretrained", "task", "settings", "sim", "seed", "port"],
        "Output": ["record", "output", "json"],
    }
)
def play(request: PlayRequest, pretrained: Pretrained = False, json: Json = None) -> None:
    """Steer a policy's robot in a browser: commands, pushes, friction, pause, slow motion, recordings."""
    from rlctl import output
    from rlctl.playing.play import run_play, show

    checkpoint = choose_checkpoint(request.checkpoint, pretrained)
    result = run_play(
        dataclasses.replace(request, checkpoint=checkpoint),
        lambda address: output.print_notes([f"open {address} in a browser; Ctrl-C ends"]),
    )
    show(result, json)


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
    sim: Sim = None,
    seed: Annotated[int, Option("Seed of the search, or of the trajectory.", min=0)] = 0,
    json: Json = None,
) -> None:
    """Estimate the physical values with which the simulation follows a log of the robot."""
    from rlctl import output
    from rlctl.deploy.identify.excite import show_excitation, write_excitation
    from rlctl.deploy.identify.identify import identify, show
    from rlctl.recipe.sources import make_spec

    spec = parse_changes(settings, sim).apply(make_spec(task))
    if excite is not None and log is None:
        show_excitation(write_excitation(spec, excite, seconds=seconds, seed=seed), json)
        return
    if log is None or excite is not None:
        raise UsageError("give either --excite FILE or --log FILE")
    result = identify(spec, log, events=events, seed=seed, report=lambda line: output.err().print(f"identify: {line}"))
    show(result, json)
