"""What acts in an evaluation or a replay, and the environment that it acts in."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError, explain_missing_package
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.play.workers import Workers
from rlctl.policy.actor import Actor
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.load import check_playable, load_policy
from rlctl.policy.named_actors import BASELINES, SERVER, load_function
from rlctl.runs import lookup


@dataclasses.dataclass(frozen=True)
class LoadedPolicy:
    """A policy that workers can play."""

    path: Path
    info: PolicyInfo
    policy: PolicyFile | None  # None for an exported file, which the workers load themselves

    @property
    def name(self) -> str:
        """The path of the file, as text."""
        return str(self.path)

    def give_to(self, workers: Workers) -> None:
        """Let workers act with the policy; raises `ArtifactError` if its spaces differ from the environment's."""
        self.info.check_fits(workers.info, self.path)
        if self.policy is None:
            workers.set_other_policy(str(self.path.resolve()))
        else:
            workers.set_policy(self.policy)


def load_player(path: Path, deterministic: bool) -> LoadedPolicy:
    """Read a policy and check that it can act; raises `ArtifactError` for a damaged one."""
    if path.suffix == ".onnx":
        info = load_policy(path).info
        if not deterministic:
            raise UsageError("an exported policy cannot sample: the ONNX file contains only its deterministic action")
        return LoadedPolicy(path, info, None)
    policy = check_playable(PolicyFile.read(path))
    return LoadedPolicy(path, policy.info, policy)


def choose_spec(info: PolicyInfo, request: EvalRequest) -> EnvSpec:
    """Return the environment to evaluate in: of the policy's task, another task, or a stage, with changes."""
    if request.spec is not None:  # only the observation settings come from the policy
        return request.spec.observe_as(info.spec)
    if (stage := request.stage) is None:
        return info.derive_spec(request.task, request.changes)
    if request.task is not None and request.task != info.spec.task:
        raise UsageError(f"--stage: the policy has only stages of {info.spec.task}; leave out --task")
    if not 1 <= stage <= len(info.stages):
        raise UsageError(f"--stage {stage}: this policy has {output.format_count(len(info.stages), 'stage')}")
    return request.changes.apply(info.stages[stage - 1].replace_missing_engine())


def find_player(
    request: EvalRequest, print_notes: Callable[[Sequence[str]], None] = output.print_notes
) -> tuple[lookup.FoundPolicy, LoadedPolicy, EnvSpec]:
    """Find and read the policy of a request; return it with its environment. `print_notes` prints which was chosen."""
    source = lookup.find_policy(request.run, request.checkpoint)
    print_notes(source.notes)
    policy = load_player(source.file, request.deterministic)
    return source, policy, source.locate(choose_spec(policy.info, request))


@dataclasses.dataclass(frozen=True)
class Baseline:
    """Zero or random actions, a policy server, or a user's function, by the name that `make_actor` takes."""

    name: str
    info: None = None

    def give_to(self, workers: Workers) -> None:
        """Let workers act with the baseline."""
        workers.set_other_policy(self.name)

    def make_actor(self, env: Any) -> Actor:
        """Return an actor for an environment in this process."""
        from rlctl.play.worker import make_actor_of

        return make_actor_of(self.name, env)

    @property
    def title(self) -> str:
        """The name without folders: `zero`, `policy.py:act`."""
        return self.name if self.name.startswith(SERVER) else self.name.rpartition("/")[2]


def load_baseline(name: str) -> Baseline:
    """Return the baseline of `--policy`; raises `UsageError` if it does not exist."""
    if name.startswith(SERVER):
        try:
            from rlctl.play.remote import PolicyClient
        except ModuleNotFoundError as error:
            raise UsageError(explain_missing_package(f"--policy {name}", error.name, "serve")) from None
        PolicyClient(name).close()  # raises if no policy server answers, before environments are built
    elif name not in BASELINES:
        load_function(name)  # raises before environments are built
    place, _, function = name.rpartition(":")
    return Baseline(f"{Path(place).expanduser().resolve()}:{function}" if place.endswith(".py") else name)


def choose_task(task: str | None, policy: str, command: str) -> EnvSpec:
    """Return a task as its recipe would train it, in the last stage; observations are not stacked.

    `policy` and `command` are `--policy` and the verb, for errors. Raises `UsageError` for a run or a policy file.
    """
    if task is None:
        raise UsageError(f"--policy {policy}: give the task to play: rlctl {command} reach --policy {policy}")
    is_file = Path(task).suffix in (".safetensors", ".onnx", ".npz")
    if is_file or task == "latest" or (Path(task) / "run.json").is_file():
        what = "a file" if is_file else "a run"
        raise UsageError(
            f"--policy {policy} plays a task, and {task} is {what}: leave out --policy, "
            f"or name its task: rlctl {command} TASK --policy {policy}"
        )
    return resolve_task(task)


def resolve_task(task: str) -> EnvSpec:
    """Return a task as its recipe would train it, in the last stage; observations are not stacked."""
    from rlctl.recipe.sources import resolve_with_stages

    spec = resolve_with_stages(task).env_specs(task)[-1].resolve()
    return dataclasses.replace(spec.observe_as(EnvSpec(task)), stage=0)
