"""`rlctl push`."""

from typing import Annotated

from rlctl.cli.arguments import command
from rlctl.options import Argument, Json, RunName


@command
def push(
    run: RunName,
    address: Annotated[str, Argument("hf://ORG/NAME, s3://BUCKET/NAME or another scheme of fsspec.")],
    json: Json = None,
) -> None:
    """Upload a run's best policy, recipe, scores, recording and a model card to an address."""
    from rlctl.runs.push import push_run, show

    return show(push_run(run, address), json)
