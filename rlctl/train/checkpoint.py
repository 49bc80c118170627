"""Checkpoints: everything to go on with a training, without pickle.

A folder with `policy.safetensors` (a policy file), `state.safetensors` (optimisers and other tensors), `state.json`
(counters, and each file's sha256) and, for off-policy algorithms, `replay.npz`. It appears whole or not at all.
"""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from rlctl.errors import ArtifactError
from rlctl.run import files
from rlctl.run.directory import RunDirectory
from rlctl.run.policy import PolicyInfo, save_policy
from rlctl.train.pack import observation_statistics

FORMAT = 1
_POLICY, _STATE, _TENSORS, _REPLAY = "policy.safetensors", "state.json", "state.safetensors", "replay.npz"
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_n_calls", "exploration_rate")


def save(
    run: RunDirectory,
    model: BaseAlgorithm,
    packed: tuple[PolicyInfo, dict[str, Any]],
    progress: dict[str, Any],
    keep: int,
) -> Path:
    """Write a checkpoint of the present step and remove the oldest beyond `keep`; return its folder.

    `progress` is what the training loop wants back, as JSON.
    """
    target = run.checkpoint(model.num_timesteps)
    tensors, structure = _flatten(model.get_parameters())
    with files.whole_folder(target) as folder:
        save_policy(folder / _POLICY, *packed)
        files.write_bytes(folder / _TENSORS, save_tensors({**tensors, **_normalizer_tensors(model)}))
        if isinstance(model, OffPolicyAlgorithm):
            files.write_npz(folder / _REPLAY, _replay_arrays(model))
        state = {
            "format": FORMAT,
            "counters": {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)},
            "parameters": structure,
            "progress": progress,
            "sha256": {file.name: _digest(file) for file in sorted(folder.iterdir())},
        }
        files.write_json(folder / _STATE, state)
    for old in run.checkpoints()[:-keep]:
        shutil.rmtree(old)
    return target


def newest(run: RunDirectory) -> tuple[Path, dict[str, Any]]:
    """Return the newest undamaged checkpoint and its state; raises `ArtifactError` if there is none."""
    damage: ArtifactError | None = None
    for folder in reversed(run.checkpoints()):
        try:
            return folder, read_state(folder)
        except ArtifactError as error:
            damage = damage or error
    raise damage or ArtifactError(f"{run.path}: no checkpoint yet; start anew with rlctl train")


def read_state(folder: Path) -> dict[str, Any]:
    """Read and check a checkpoint's `state.json` and its files' hashes."""
    state = files.read_json(folder / _STATE)
    if not isinstance(state, dict) or not isinstance(state.get("format"), int):
        raise ArtifactError(f"{folder}: not a checkpoint of rlctl")
    if state["format"] > FORMAT:
        raise ArtifactError(f"{folder}: checkpoint format {state['format']} is newer than this rlctl reads ({FORMAT})")
    for name, digest in state["sha256"].items():
        if not (folder / name).is_file():
            raise ArtifactError(f"{folder / name}: missing")
        if _digest(folder / name) != digest:
            raise ArtifactError(f"{folder / name}: damaged: its sha256 is not the one it was saved with")
    return state


def restore(model: BaseAlgorithm, folder: Path, state: dict[str, Any]) -> None:
    """Put weights, optimisers, normalisation, counters and replay buffer of a checkpoint into a model."""
    tensors = load_tensors((folder / _TENSORS).read_bytes())
    try:
        model.set_parameters(_unflatten(state["parameters"], tensors), exact_match=True, device=model.device)
        _restore_normalizer(model, tensors)
    except (KeyError, ValueError, RuntimeError) as error:
        raise ArtifactError(f"{folder}: does not fit this recipe: {' '.join(str(error).split())[:200]}") from None
    for name, value in state["counters"].items():
        setattr(model, name, value)
    if isinstance(model, OffPolicyAlgorithm):
        _restore_replay(model, files.read_npz(folder / _REPLAY))


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _flatten(value: Any, path: str = "parameters") -> tuple[dict[str, Any], Any]:
    """Split nested state dicts into tensors by path, and JSON that refers to them."""
    if isinstance(value, torch.Tensor):
        return {path: value.detach().cpu().numpy().copy()}, {"tensor": path}
    if isinstance(value, dict):
        tensors: dict[str, Any] = {}
        entries = []
        for key, each in value.items():
            below, structure = _flatten(each, f"{path}/{key}")
            tensors.update(below)
            entries.append([key, structure])
        return tensors, {"dict": entries}
    if isinstance(value, list | tuple):
        below, structure = _flatten(dict(enumerate(value)), path)
        kind = "list" if isinstance(value, list) else "tuple"
        return below, {kind: [each for _, each in structure["dict"]]}
    return {}, {"value": value}


def _unflatten(structure: Any, tensors: dict[str, Any]) -> Any:
    ((kind, content),) = structure.items()
    if kind == "tensor":
        return torch.from_numpy(tensors[content].copy())
    if kind == "dict":
        return {key: _unflatten(each, tensors) for key, each in content}
    if kind in ("list", "tuple"):
        items = [_unflatten(each, tensors) for each in content]
        return items if kind == "list" else tuple(items)
    return content


def _normalizer_tensors(model: BaseAlgorithm) -> dict[str, Any]:
    normalizer = model.get_vec_normalize_env()
    if normalizer is None:
        return {}
    tensors: dict[str, Any] = {"normalize/returns": normalizer.returns}
    for key, rms in {**observation_statistics(normalizer), "return": normalizer.ret_rms}.items():
        tensors[f"normalize/{key}/mean"] = np.asarray(rms.mean)
        tensors[f"normalize/{key}/var"] = np.asarray(rms.var)
        tensors[f"normalize/{key}/count"] = np.asarray(rms.count)
    return tensors


def _restore_normalizer(model: BaseAlgorithm, tensors: dict[str, Any]) -> None:
    normalizer = model.get_vec_normalize_env()
    if normalizer is None:
        return
    normalizer.returns = tensors["normalize/returns"].copy()
    for key, rms in {**observation_statistics(normalizer), "return": normalizer.ret_rms}.items():
        rms.mean = tensors[f"normalize/{key}/mean"].copy()
        rms.var = tensors[f"normalize/{key}/var"].copy()
        rms.count = float(tensors[f"normalize/{key}/count"])


_REPLAY_FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def _replay_arrays(model: OffPolicyAlgorithm) -> dict[str, Any]:
    buffer = _buffer(model)
    filled = buffer.size()
    arrays = {"position": np.array(buffer.pos), "full": np.array(buffer.full)}
    for name in _REPLAY_FIELDS:
        values = getattr(buffer, name)
        if isinstance(values, dict):
            arrays.update({f"{name}/{key}": value[:filled] for key, value in values.items()})
        else:
            arrays[name] = values[:filled]
    return arrays


def _restore_replay(model: OffPolicyAlgorithm, arrays: dict[str, Any]) -> None:
    buffer = _buffer(model)
    for name, stored in arrays.items():
        field, _, key = name.partition("/")
        if field in _REPLAY_FIELDS:
            values = getattr(buffer, field)
            (values[key] if key else values)[: len(stored)] = stored
    buffer.pos, buffer.full = int(arrays["position"]), bool(arrays["full"])


def _buffer(model: OffPolicyAlgorithm) -> ReplayBuffer | DictReplayBuffer:
    assert model.replay_buffer is not None  # SB3 makes it in its constructor
    return model.replay_buffer
