"""`rlctl serve`."""

import dataclasses
from typing import Annotated

from rlctl.arguments import choose_checkpoint, command, parse_changes
from rlctl.options import Checkpoint, Json, Option, Pretrained, RunName, SimOption
from rlctl_robot.serve.serve_request import ServeRequest


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
    sim: SimOption = None,
    json: Json = None,
) -> None:
    """Serve a policy to robots: WebSocket and HTTP, with limits, watchdog, log and a live page."""
    from rlctl import output
    from rlctl.errors import UsageError
    from rlctl.runs.lookup import find_policy
    from rlctl_robot.serve.serve import make_server, run_server

    if sim is not None and not self_test:
        raise UsageError("--sim: only the self-test simulates; add --self-test")
    policy = find_policy(run, choose_checkpoint(checkpoint, pretrained))
    output.print_notes(policy.notes)
    if request.limits is None:
        output.print_notes(["warning: no --limits FILE: only the policy's own bounds of actions limit the robot"])
    if self_test:
        # First: it explains a missing package, which the self-test imports.
        server = make_server(policy.file, dataclasses.replace(request, port=0, watchdog=False))
        from rlctl.evaluation.eval_request import EvalRequest
        from rlctl_robot.serve import self_test as test

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

    server = make_server(policy.file, request)
    run_server(server, show)
    output.print_notes([server.summarize()])
    return None
