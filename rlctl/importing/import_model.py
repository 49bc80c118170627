"""`rlctl runs import`: a model of Stable-Baselines3 or rl-zoo3 becomes a policy file."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.info import EnvInfo, describe
from rlctl.environments.spec import UNCHANGED, EnvChanges, EnvSpec
from rlctl.errors import ArtifactError, UsageError, did_you_mean
from rlctl.importing.sb3_model import SavedModel, SavedNormalization, read_model, read_normalization
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.numpy_policy import load_policy
from rlctl.storage import files
from rlctl.version import collect_versions


@dataclasses.dataclass(frozen=True)
class ImportedPolicy:
    """The policy file that was written."""

    file: Path
    info: PolicyInfo


def import_model(
    file: Path,
    task: str,
    *,
    normalization: Path | None = None,
    algo: str | None = None,
    output: Path | None = None,
    changes: EnvChanges = UNCHANGED,
) -> ImportedPolicy:
    """Read a model, and a VecNormalize if it has one, and write it as a policy of a task, once it acts.

    Raises `UsageError` for another ending of `output` than .safetensors, or where nothing was said and the model's name
    is taken, `ArtifactError` for a file that is not a model, or one for other spaces than the task has.
    """
    from rlctl.policy.torch_policy import ALGORITHMS, build_network, describe_network, policy_name

    if output is not None and output.suffix != ".safetensors":
        raise UsageError(f"--output {output}: the name of a policy file ends in .safetensors")
    target = output or Path(f"{file.stem}.safetensors")
    if output is None and target.exists():  # rl-zoo3 calls every model best_model.zip
        raise UsageError(f"{target} is there already; give another name: --output FILE")
    if algo is not None and algo not in ALGORITHMS:
        raise UsageError(f"--algo {algo}: no such algorithm.{did_you_mean(algo, ALGORITHMS)}")
    model = read_model(file, algo)
    statistics = read_normalization(normalization) if normalization else None
    spec = changes.apply(EnvSpec(task))
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
        normalized_keys=list(statistics.mean) if statistics else [],
        env=env_info,
        spec=spec,
        training_steps=model.training_steps,
        versions={**collect_versions(), "stable-baselines3": model.version},
    )
    try:
        # As described by the network itself, with what SB3 fills in: its defaults may change.
        info = info.model_copy(update={"policy_kwargs": describe_network(build_network(info))})
    except (TypeError, ValueError, AssertionError) as error:
        raise ArtifactError(f"{file}: its policy_kwargs make no network for {task}: {error}") from None
    read = f"{file} with {normalization}" if normalization else str(file)
    _write_checked(target, read, PolicyFile(info, _collect_tensors(model, statistics)))
    return ImportedPolicy(target, info)


def _describe_env(spec: EnvSpec) -> EnvInfo:
    with contextlib.closing(spec.make()) as env:
        return describe(env)


def _has_time_feature(model: SavedModel, env: EnvInfo) -> bool:
    """Say whether a model observes one number more than a task gives, the last one, which is in [0, 1]."""
    ours, theirs = (_flat_part(space) for space in (env.spaces()[0], model.observation_space))
    if ours is None or theirs is None or theirs.shape[0] != ours.shape[0] + 1:
        return False
    return bool(theirs.low[-1] == 0.0 and theirs.high[-1] == 1.0)


def _flat_part(space: spaces.Space[Any]) -> spaces.Box | None:
    """Return what the time feature is appended to, if the space has it: itself, or its entry `observation`."""
    part = space.spaces.get("observation") if isinstance(space, spaces.Dict) else space
    return part if isinstance(part, spaces.Box) and len(part.shape) == 1 else None


def _find_difference(
    model: SavedModel, task: str, observation: spaces.Space[Any], action: spaces.Space[Any]
) -> str | None:
    """Say how the spaces of a task differ from a model's; None if the model can act in it.

    Bounds of actions must agree, because a policy scales to them; those of observations are often declared anew.
    """
    from rlctl.policy.torch_policy import network_space

    seen = network_space(observation)
    if _describe_shape(seen) != _describe_shape(model.observation_space):
        ours, theirs = _flat_part(seen), _flat_part(model.observation_space)
        is_stack = ours is not None and theirs is not None and theirs.shape[0] % ours.shape[0] == 0
        hint = ". Stacks of VecFrameStack, which begin with zeros, are not imported" if is_stack else ""
        return f"it observes {_describe_shape(model.observation_space)}, {task} gives {_describe_shape(seen)}{hint}"
    same = _describe_shape(action) == _describe_shape(model.action_space)
    if same and isinstance(action, spaces.Box) and isinstance(model.action_space, spaces.Box):
        same = np.allclose(action.low, model.action_space.low) and np.allclose(action.high, model.action_space.high)
    return None if same else f"its actions are {model.action_space}, those of {task} {action}"


def _describe_shape(space: spaces.Space[Any]) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _describe_shape(part) for key, part in space.spaces.items()}
    counts = isinstance(space, spaces.Discrete | spaces.MultiDiscrete)
    return str(space) if counts else f"{type(space).__name__}{space.shape}"


def _collect_tensors(model: SavedModel, normalization: SavedNormalization | None) -> dict[str, NDArray[Any]]:
    tensors = {f"policy/{name}": values for name, values in model.tensors.items()}
    if normalization is not None:
        for key, mean in normalization.mean.items():
            tensors |= {f"normalize/{key}/mean": mean, f"normalize/{key}/var": normalization.var[key]}
    return tensors


def _write_checked(output: Path, read: str, policy: PolicyFile) -> None:
    """Write the file under another name, load it, and rename it only if it acts; errors name what was `read`."""
    from rlctl.policy.torch_policy import TorchPolicy

    def write(part: Path) -> None:
        policy.write(part)
        try:
            load_policy(part)
            TorchPolicy.load(part)  # which is stricter
        except ArtifactError as error:
            raise ArtifactError(str(error).replace(str(part), read)) from None

    files.write_with(output, write)


def show(result: ImportedPolicy, json: str | None) -> None:
    """Print what was imported and what to type next, or JSON alone for `-`."""
    from rlctl import output

    info, normalizes = result.info, result.info.clip_observation is not None
    if json is not None:
        content = {
            "policy": str(result.file),
            "algo": info.algo,
            "task": info.spec.task,
            "normalizes": normalizes,
            "time_feature": info.spec.time_feature,
        }
        if output.present({**content, "training_steps": info.training_steps, "versions": info.versions}, json):
            return
    out = output.out()
    normalization = "with" if normalizes else "without"
    out.print(f"{result.file}: {info.algo}, step {info.training_steps:,}, {normalization} observation normalisation")
    if info.spec.time_feature:
        out.print("it also observes the part of the episode that is left, the time feature of rl-zoo3")
    out.print("next:")
    for command in (f"rlctl eval {result.file}", f"rlctl export {result.file} --onnx", f"rlctl replay {result.file}"):
        out.print(f"  {command}")
