"""`rlctl runs import`: write a model of Stable-Baselines3 or rl-zoo3 as a policy file."""

import contextlib
import dataclasses
import shlex
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl import output
from rlctl.environments.info import EnvInfo, describe
from rlctl.environments.registry import find_origin
from rlctl.environments.spec import UNCHANGED, EnvChanges, EnvSpec
from rlctl.errors import ArtifactError, UsageError
from rlctl.importing.sb3_model import SavedModel, read_model, read_normalization
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.load import load_policy
from rlctl.recipe.recipe_files import make_spec
from rlctl.storage import files
from rlctl.version import collect_versions

NO_NORMALIZATION = Path("none")
_MOST_PICKLES = 20  # near a model that are read


def import_model(
    file: Path,
    task: str,
    *,
    normalization: Path | None = None,
    algo: str | None = None,
    output: Path | None = None,
    changes: EnvChanges = UNCHANGED,
) -> PolicyFile:
    """Read a model and its VecNormalize, if it has one; write them as a policy file, after a test that it acts.

    Raises `UsageError` if `output` does not end in .safetensors, or if it is None and the file named after the model
    exists; `ArtifactError` for a file that is not a model, or a model for other spaces than the task has.
    """
    from rlctl.policy.torch_policy import build_network, describe_network, policy_name

    if output is not None and output.suffix != ".safetensors":
        raise UsageError(f"--output {output}: the name of a policy file ends in .safetensors")
    target = output or Path(f"{file.stem}.safetensors")
    if output is None and target.exists():  # rl-zoo3 calls every model best_model.zip
        raise UsageError(f"{target} exists already; give another name: --output FILE")
    model = read_model(file, algo)
    statistics = read_normalization(normalization) if normalization else None
    spec = changes.apply(make_spec(task))
    env_info = _describe_env(spec)
    if _has_time_feature(model, env_info):
        spec = dataclasses.replace(spec, time_feature=True)
        env_info = _describe_env(spec)
    if (difference := _find_difference(model, task, *env_info.spaces())) is not None:
        raise ArtifactError(f"{file}: {difference}")
    info = PolicyInfo(
        algo=model.algo,
        policy=policy_name(model.algo, env_info.spaces()[0]),
        policy_kwargs=model.policy_kwargs,
        clip_observation=statistics.clip if statistics else None,
        normalized_keys=statistics.keys if statistics else [],
        env=env_info,
        spec=spec,
        training_steps=model.training_steps,
        versions={**collect_versions(), "stable-baselines3": model.version},
        origin=find_origin(spec.task),
    )
    try:
        # All arguments of the network, because SB3's defaults may change.
        info = info.model_copy(update={"policy_kwargs": describe_network(build_network(info))})
    except (TypeError, ValueError, AssertionError) as error:
        raise ArtifactError(f"{file}: its policy_kwargs do not make a network for {task}: {error}") from None
    source = f"{file} with {normalization}" if normalization else str(file)
    policy = PolicyFile(info, model.tensors | (statistics.tensors if statistics else {}), target)
    write_checked(target, source, policy)
    return policy


def _describe_env(spec: EnvSpec) -> EnvInfo:
    with contextlib.closing(spec.make()) as env:
        return describe(env)


def _has_time_feature(model: SavedModel, env: EnvInfo) -> bool:
    """Return whether a model observes one more number than the task returns, at the end and in [0, 1]."""
    ours, theirs = (_flat_part(space) for space in (env.spaces()[0], model.observation_space))
    if ours is None or theirs is None or theirs.shape[0] != ours.shape[0] + 1:
        return False
    return bool(theirs.low[-1] == 0.0 and theirs.high[-1] == 1.0)


def _flat_part(space: spaces.Space[Any]) -> spaces.Box | None:
    """Return the part of a space that gets the time feature: the space or its entry `observation`; None for others."""
    part = space.spaces.get("observation") if isinstance(space, spaces.Dict) else space
    return part if isinstance(part, spaces.Box) and len(part.shape) == 1 else None


def _find_difference(
    model: SavedModel, task: str, observation: spaces.Space[Any], action: spaces.Space[Any]
) -> str | None:
    """Return how the spaces of a task differ from a model's; None if the model can act in the task.

    Bounds of actions must be equal, because a policy scales actions to them; bounds of observations may differ.
    """
    from rlctl.policy.torch_policy import network_space

    space = network_space(observation)
    if _describe_shape(space) != _describe_shape(model.observation_space):
        ours, theirs = _flat_part(space), _flat_part(model.observation_space)
        is_stack = ours is not None and theirs is not None and theirs.shape[0] % ours.shape[0] == 0
        hint = (
            ". Models with VecFrameStack cannot be imported: it fills the first frames with zeros" if is_stack else ""
        )
        return f"it observes {_describe_shape(model.observation_space)}, {task} returns {_describe_shape(space)}{hint}"
    same = _describe_shape(action) == _describe_shape(model.action_space)
    if same and isinstance(action, spaces.Box) and isinstance(model.action_space, spaces.Box):
        same = np.allclose(action.low, model.action_space.low) and np.allclose(action.high, model.action_space.high)
    return None if same else f"its action space is {model.action_space}, that of {task} is {action}"


def _describe_shape(space: spaces.Space[Any]) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _describe_shape(part) for key, part in space.spaces.items()}
    counts = isinstance(space, spaces.Discrete | spaces.MultiDiscrete)
    return str(space) if counts else f"{type(space).__name__}{space.shape}"


def write_checked(target: Path, source: str, policy: PolicyFile) -> None:
    """Write the file under a temporary name, and rename it if it loads and acts; errors name `source`."""
    from rlctl.policy.torch_policy import TorchActor

    def write(part: Path) -> None:
        policy.write(part)
        try:
            load_policy(part)
            TorchActor.load(part)  # checks the names of all tensors, too
        except ArtifactError as error:
            raise ArtifactError(str(error).replace(str(part), source)) from None

    files.write_with(target, write)


def choose_normalization(file: Path, given: Path | None) -> Path | None:
    """Return the VecNormalize that was given for a model; None for `none`, or if nothing was given and none is near it.

    Raises `UsageError` if nothing was given and one is near: without its normalisation a policy acts badly, and
    nothing in the policy file would show why.
    """
    if given is not None:
        return None if given == NO_NORMALIZATION else given
    near = find_normalizations(file)
    if not near:
        return None
    options = " or ".join(f"--vecnormalize {shlex.quote(str(path))}" for path in near)
    raise UsageError(
        f"{file}: near it {'is' if len(near) == 1 else 'are'} {', '.join(map(str, near))} with a normalisation of "
        f"observations\nif the model was trained with it, add {options}; otherwise --vecnormalize none"
    )


def find_normalizations(file: Path) -> list[Path]:
    """Return the files in a model's folder, and in those below it, that are a VecNormalize of observations."""
    found = []
    for path in sorted([*file.parent.glob("*.pkl"), *file.parent.glob("*/*.pkl")])[:_MOST_PICKLES]:
        with contextlib.suppress(ArtifactError):  # something else: it is read, never unpickled
            if read_normalization(path) is not None:
                found.append(path)
    return found


def show(policy: PolicyFile, json: str | None) -> None:
    """Print what was imported and the next commands, or only JSON for `-`."""
    file, info, normalizes = policy.path, policy.info, policy.info.clip_observation is not None
    content = {
        "policy": file,
        "algo": info.algo,
        "task": info.spec.task,
        "normalizes": normalizes,
        "time_feature": info.spec.time_feature,
        "training_steps": info.training_steps,
        "versions": info.versions,
    }
    if output.present(content, json):
        return
    out = output.out()
    normalization = "with" if normalizes else "without"
    out.print(f"{file}: {info.algo}, step {info.training_steps:,}, {normalization} observation normalisation")
    if info.spec.time_feature:
        out.print("it also observes the remaining fraction of the episode, rl-zoo3's time feature")
    out.print(f"next:\n  rlctl eval {file}\n  rlctl export {file} --onnx\n  rlctl replay {file}")
