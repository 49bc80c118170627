"""What plays without training, on a task as its recipe would train it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError, explain_missing_package
from rlctl.evaluation.request import EvalRequest
from rlctl.policy.players.baselines import BASELINES, load_function
from rlctl.policy.players.named import SERVER
from rlctl.rollout.workers import Workers


@dataclasses.dataclass(frozen=True)
class Baseline:
    """Zero or random actions, a policy server, or a user's function, by the name that `make_player` takes."""

    name: str
    info: None = None

    def give_to(self, workers: Workers) -> None:
        """Let workers act with it."""
        workers.set_other_policy(self.name)


def load_baseline(request: EvalRequest) -> Baseline:
    """Return the baseline of a request; raises `UsageError` for one that is not there, and for options of a run."""
    name = str(request.baseline)
    if request.checkpoint != "best" or request.stage is not None or not request.deterministic or request.task:
        raise UsageError(
            f"--policy {name} needs a task, its --set and --episodes, and nothing of a run: leave out --checkpoint, "
            "--pretrained, --stage, --stochastic and --task"
        )
    if name in BASELINES:
        return Baseline(name)
    if name.startswith(SERVER):
        _ask_server(name)
        return Baseline(name)
    load_function(name)  # here too, so that what is wrong with it is known before environments are built
    place, _, function = name.rpartition(":")
    return Baseline(f"{Path(place).expanduser().resolve()}:{function}" if place.endswith(".py") else name)


def _ask_server(address: str) -> None:
    """Raise `UsageError` if no policy server answers, before environments are built."""
    try:
        from rlctl.deploy.server.client import PolicyClient
    except ModuleNotFoundError as error:
        raise UsageError(explain_missing_package(f"--policy {address}", error.name, "serve")) from None
    PolicyClient(address).close()


def choose_task(request: EvalRequest) -> EnvSpec:
    """Return the task of a request as its recipe would train it, in the last stage; observations are not stacked."""
    if request.spec is not None:
        return dataclasses.replace(request.spec, frame_stack=1, time_feature=False)
    if request.run is None:
        raise UsageError(f"--policy {request.baseline}: give the task to play: rlctl eval reach --policy zero")
    from rlctl.recipe.sources import resolve_packaged

    spec = resolve_packaged(request.run).env_specs(request.run)[-1]
    return request.changes.apply(dataclasses.replace(spec, frame_stack=1, time_feature=False, stage=0))
