"""`rlctl runs import`: a model of Stable-Baselines3 or rl-zoo3 becomes a policy file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.env_spec import UNCHANGED, EnvChanges, EnvSpec
from rlctl.errors import ArtifactError, UsageError, did_you_mean
from rlctl.run.env_info import EnvInfo, describe
from rlctl.run.policy import PolicyInfo, collect_versions, load_policy, save_policy
from rlctl.runs.sb3_model import SavedModel, SavedNormalization, read_model, read_normalization


@dataclasses.dataclass(frozen=True)
class ImportRequest:
    """What the command line asks for."""

    model: Path
    task: str
    normalization: Path | None = None
    algo: str | None = None
    output: Path | None = None
    changes: EnvChanges = UNCHANGED


@dataclasses.dataclass(frozen=True)
class ImportedPolicy:
    """The policy file that was written."""

    file: Path
    info: PolicyInfo
    normalizes: bool


def import_model(request: ImportRequest) -> ImportedPolicy:
    """Read a model and write it as a policy of a task, once it acts.

    Raises `ArtifactError` for a file that is not a model, or one for other spaces than the task has.
    """
    from rlctl.run.torch_policy import ALGORITHMS, build_network, describe_network, policy_name

    if request.algo is not None and request.algo not in ALGORITHMS:
        raise UsageError(f"--algo {request.algo}: no such algorithm.{did_you_mean(request.algo, ALGORITHMS)}")
    model = read_model(request.model, request.algo)
    normalization = read_normalization(request.normalization) if request.normalization else None
    spec = request.changes.apply(EnvSpec(request.task))
    env_info = _describe_env(spec)
    if _has_time_feature(model, env_info):
        spec = dataclasses.replace(spec, time_feature=True)
        env_info = _describe_env(spec)
    _check_spaces(request, model, *env_info.spaces())
    info = PolicyInfo(
        algo=model.algo,
        policy=policy_name(model.algo, env_info.spaces()[0]),
        policy_kwargs=model.policy_kwargs,
        clip_observation=normalization.clip if normalization else None,
        normalized_keys=list(normalization.mean) if normalization else [],
        env=env_info,
        spec=spec,
        training_steps=model.training_steps,
        versions={**collect_versions(), "stable-baselines3": model.version},
    )
    try:
        # As described by the network itself, with what SB3 fills in: its defaults may change.
        info = info.model_copy(update={"policy_kwargs": describe_network(build_network(info))})
    except (TypeError, ValueError, AssertionError) as error:
        raise ArtifactError(f"{request.model}: its policy_kwargs make no network for {request.task}: {error}") from None
    output = request.output or Path(f"{request.model.stem}.safetensors")
    _write_checked(output, info, _collect_tensors(model, normalization))
    return ImportedPolicy(output, info, normalization is not None)


def _describe_env(spec: EnvSpec) -> EnvInfo:
    env = spec.make()
    try:
        return describe(env)
    finally:
        env.close()


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


def _check_spaces(
    request: ImportRequest, model: SavedModel, observation: spaces.Space[Any], action: spaces.Space[Any]
) -> None:
    """Bounds of actions must agree, because a policy scales to them; those of observations are often declared anew."""
    from rlctl.run.torch_policy import network_space

    seen = network_space(observation)
    if _describe_shape(seen) != _describe_shape(model.observation_space):
        raise ArtifactError(
            f"{request.model}: it observes {_describe_shape(model.observation_space)}, "
            f"{request.task} gives {_describe_shape(seen)}"
        )
    same = _describe_shape(action) == _describe_shape(model.action_space)
    if same and isinstance(action, spaces.Box) and isinstance(model.action_space, spaces.Box):
        same = np.allclose(action.low, model.action_space.low) and np.allclose(action.high, model.action_space.high)
    if not same:
        raise ArtifactError(f"{request.model}: its actions are {model.action_space}, those of {request.task} {action}")


def _describe_shape(space: spaces.Space[Any]) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _describe_shape(each) for key, each in space.spaces.items()}
    return (
        str(space)
        if isinstance(space, spaces.Discrete | spaces.MultiDiscrete)
        else f"{type(space).__name__}{space.shape}"
    )


def _collect_tensors(model: SavedModel, normalization: SavedNormalization | None) -> dict[str, NDArray[Any]]:
    tensors = {f"policy/{name}": values for name, values in model.tensors.items()}
    for key in normalization.mean if normalization else ():
        assert normalization is not None
        tensors[f"normalize/{key}/mean"] = normalization.mean[key]
        tensors[f"normalize/{key}/var"] = normalization.var[key]
    return tensors


def _write_checked(output: Path, info: PolicyInfo, tensors: dict[str, NDArray[Any]]) -> None:
    """Write the file beside its place, load it, and put it in place only if it acts."""
    from rlctl.run.torch_policy import TorchPolicy

    beside = output.with_name(f".{output.stem}.import.safetensors")
    save_policy(beside, info, tensors)
    try:
        load_policy(beside)
        TorchPolicy.load(beside)  # which is stricter
        beside.replace(output)
    except ArtifactError as error:
        raise ArtifactError(str(error).replace(str(beside), str(output))) from None
    finally:
        beside.unlink(missing_ok=True)


def show(result: ImportedPolicy, json: str | None) -> None:
    """Print what was imported and what to type next, or write it as JSON."""
    from rlctl import output

    info = result.info
    if json is not None:
        content = {
            "policy": str(result.file),
            "algo": info.algo,
            "task": info.spec.task,
            "normalizes": result.normalizes,
            "time_feature": info.spec.time_feature,
        }
        output.write_result_json(json, {**content, "training_steps": info.training_steps, "versions": info.versions})
        return
    out = output.out()
    normalization = "with" if result.normalizes else "without"
    out.print(f"{result.file}: {info.algo}, step {info.training_steps:,}, {normalization} observation normalisation")
    if info.spec.time_feature:
        out.print("it also observes the part of the episode that is left, the time feature of rl-zoo3")
    out.print("next:")
    for command in (f"rlctl eval {result.file}", f"rlctl export {result.file} --onnx", f"rlctl replay {result.file}"):
        out.print(f"  {command}", markup=False)
