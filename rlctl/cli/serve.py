"""`rlctl serve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlctl.cli.arguments import Checkpoint, Json, Pretrained, Run, choose_checkpoint, claim_stdout


def serve(
    run: Run = None,
    checkpoint: Checkpoint = "best",
    pretrained: Pretrained = False,
    host: Annotated[str, typer.Option(help="Address to listen on; others than loopback need a key.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on; 0: any that is free.", min=0, max=65535)] = 8000,
    limits: Annotated[Path | None, typer.Option(metavar="FILE", help="Safety limits (YAML).")] = None,
    log: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Log of events, as JSON lines, rotated at 10 MB.")
    ] = None,
    rerun: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Record actions and observations for Rerun (.rrd).")
    ] = None,
    key_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Key that clients must send; or RLCTL_API_KEY.")
    ] = None,
    max_clients: Annotated[int, typer.Option(help="Clients that may be connected at once.", min=1)] = 64,
    self_test: Annotated[
        bool,
        typer.Option("--self-test", help="Play the task through the server in simulation, and say how good it is."),
    ] = False,
    episodes: Annotated[int, typer.Option(help="Episodes of the self-test.", min=1)] = 100,
    json: Json = None,
) -> None:
    """Serve a policy to robots: WebSocket and HTTP, with limits, watchdog, log and a live page."""
    claim_stdout()
    from rlctl import output
    from rlctl.deploy.server.serve import ServerSettings, make_server, run_server
    from rlctl.run.lookup import find_policy

    chosen = choose_checkpoint(checkpoint, pretrained)
    found = find_policy(run, chosen)
    output.print_notes(found.notes)
    settings = ServerSettings(
        host=host,
        port=0 if self_test else port,
        limits=limits,
        log=log,
        rerun=rerun,
        key_file=key_file,
        max_clients=max_clients,
        watchdog=not self_test,  # a simulation does not keep real time
    )
    server = make_server(found.file, settings)
    if self_test:
        from rlctl.evaluation.request import EvalRequest
        from rlctl.evaluation.self_test import run_self_test
        from rlctl.evaluation.self_test import show as show_test

        result = run_self_test(server, EvalRequest(str(found.file), episodes=episodes, limits=limits))
        show_test(result, json)
        return result.check()

    def show(address: str) -> None:
        out = output.out()
        out.print(f"{found.file}: serving at ws://{address}, live page at http://{address}/")
        out.file.flush()

    return run_server(server, show)
