"""`rlctl serve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlctl.cli.arguments import Checkpoint, Run, claim_stdout


def serve(
    run: Run = None,
    checkpoint: Checkpoint = "best",
    host: Annotated[str, typer.Option(help="Address to listen on; others than loopback need a key.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on; 0: any that is free.", min=0, max=65535)] = 8000,
    limits: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Safety limits (YAML).", show_default=False)
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Log of events, as JSON lines, rotated at 10 MB.", show_default=False),
    ] = None,
    key_file: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Key that clients must send; or RLCTL_API_KEY.", show_default=False),
    ] = None,
    max_clients: Annotated[int, typer.Option(help="Clients that may be connected at once.", min=1)] = 64,
) -> None:
    """Serve a policy to robots: WebSocket and HTTP, with limits, watchdog, log and a live page."""
    claim_stdout()
    from rlctl import output
    from rlctl.deploy.serve import make_server, run_server
    from rlctl.run.lookup import find_policy

    found = find_policy(run, checkpoint)
    output.print_notes(found.notes)
    server = make_server(
        found.file, host=host, port=port, limits=limits, log=log, key_file=key_file, max_clients=max_clients
    )

    def show(address: str) -> None:
        out = output.out()
        out.print(f"{found.file}: serving at ws://{address}, live page at http://{address}/", markup=False)
        out.file.flush()

    run_server(server, show)
