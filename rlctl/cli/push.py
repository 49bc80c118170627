"""`rlctl push`."""

from __future__ import annotations

from typing import Annotated

import typer

from rlctl.cli.arguments import Json, Run, claim_stdout


def push(
    run: Run,
    address: Annotated[str, typer.Argument(help="hf://ORG/NAME, s3://BUCKET/NAME or another scheme of fsspec.")],
    json: Json = None,
) -> None:
    """Upload a run's best policy, recipe, scores, recording and a model card to an address."""
    claim_stdout()
    from rlctl.runs.push import push_run, show

    return show(push_run(run, address), json)
