"""Reads files of Stable-Baselines3 and rl-zoo3, model.zip and vecnormalize.pkl, without unpickling them."""

import base64
import contextlib
import dataclasses
import json
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.errors import ArtifactError, UsageError, short_repr
from rlctl.importing import pickle_data
from rlctl.importing.pickle_data import Call, Name, NotPlainData, read_array, read_dtype, read_plain
from rlctl.importing.tensor_file import LARGEST_MEMBER, read_member, read_tensors
from rlctl.storage import untrusted

_POLICIES = {
    "stable_baselines3.sac": "sac",
    "stable_baselines3.td3": "td3",
    "stable_baselines3.dqn": "dqn",
    "stable_baselines3.common.policies": "ppo",
    "sb3_contrib.tqc": "tqc",
    "sb3_contrib.crossq": "crossq",
    "sb3_contrib.common.recurrent": "recurrent_ppo",
}
"""Module of the policy class -> algorithm; a model does not contain the name of its algorithm."""
_SAME_POLICY = ({"ppo", "a2c"}, {"td3", "ddpg"})
_ACTIVATIONS = {"Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "SiLU": "silu"}
_EXTRACTORS = frozenset({"FlattenExtractor", "NatureCNN", "CombinedExtractor"})
_NOT_OF_THE_NETWORK = frozenset({"optimizer_class", "optimizer_kwargs", "device"})
"""Arguments of a policy that do not change what it computes; versions of SB3 before 1.0 write its device."""


@dataclasses.dataclass(frozen=True)
class SavedModel:
    """A model of Stable-Baselines3 or sb3-contrib."""

    algo: str
    observation_space: spaces.Space[Any]  # the network's: images have the channels first
    action_space: spaces.Space[Any]
    policy_kwargs: dict[str, Any]  # plain data; `activation_fn` has its name in recipes
    tensors: dict[str, NDArray[Any]]  # the tensors of the policy, by the names of policy files
    training_steps: int
    version: str  # the version of Stable-Baselines3; empty if unknown


@dataclasses.dataclass(frozen=True)
class SavedNormalization:
    """The statistics of a `VecNormalize`."""

    keys: list[str]  # of a dict observation; `""` for any other observation
    tensors: dict[str, NDArray[np.float64]]  # mean and variance, by the names of policy files
    clip: float


def read_model(path: Path, algo: str | None = None) -> SavedModel:
    """Read a model.zip; raises `ArtifactError` if it is not a model, is too large, or has unsupported data.

    `algo` chooses between algorithms whose files look the same: A2C and PPO, DDPG and TD3. Raises `UsageError` for any
    other algorithm than the model's.
    """
    with _explain_errors(path, "a model"), untrusted.open_file(path) as file, zipfile.ZipFile(file) as archive:
        data, policy = json.loads(read_member(archive, "data")), read_member(archive, "policy.pth")
        if not isinstance(data, dict):
            raise NotPlainData("its data is not a mapping")
        saved_algo = _find_algorithm(data)
        if algo not in (None, saved_algo) and {algo, saved_algo} not in _SAME_POLICY:
            raise UsageError(f"--algo {algo}: {path} is a {saved_algo} model")
        return SavedModel(
            algo=algo or saved_algo,
            observation_space=read_space(_decode(data, "observation_space")),
            action_space=read_space(_decode(data, "action_space")),
            policy_kwargs=_read_policy_kwargs(data),
            tensors={f"policy/{name}": values for name, values in read_tensors(policy).items()},
            training_steps=int(data.get("num_timesteps") or 0),
            version=read_member(archive, _VERSION).decode().strip() if _VERSION in archive.namelist() else "",
        )


@contextlib.contextmanager
def _explain_errors(path: Path, what: str) -> Iterator[None]:
    """Turn exceptions from reading an unchecked file into `ArtifactError`."""
    try:
        yield
    except NotPlainData as error:
        raise ArtifactError(f"{path}: it has data that cannot be imported: {error}") from None
    except (*untrusted.ZIP_ERRORS, KeyError, TypeError, AttributeError) as error:
        raise ArtifactError(f"{path}: not {what} of Stable-Baselines3, or damaged: {error}") from None


_VERSION = "_stable_baselines3_version"


def _decode(data: Mapping[str, Any], key: str) -> Any:
    """Return an entry of the model's data: plain JSON, or the value that its pickle describes."""
    entry = data.get(key)
    if isinstance(entry, dict) and ":serialized:" in entry:
        return pickle_data.read(base64.b64decode(entry[":serialized:"]))
    return entry


def _find_algorithm(data: Mapping[str, Any]) -> str:
    policy = _decode(data, "policy_class")
    if not isinstance(policy, Name):
        raise NotPlainData("a policy class that the user wrote")
    algo = next((algo for module, algo in _POLICIES.items() if policy.module.startswith(module)), None)
    if algo is None:
        raise NotPlainData(f"policy class {policy}")
    if algo == "ppo" and "n_epochs" not in data:
        return "a2c"
    if algo == "td3" and data.get("policy_delay") == 1 and not data.get("target_noise_clip"):
        return "ddpg"
    return algo


def _read_policy_kwargs(data: Mapping[str, Any]) -> dict[str, Any]:
    kwargs: dict[str, Any] = {"use_sde": True} if data.get("use_sde") else {}
    for key, value in (_decode(data, "policy_kwargs") or {}).items():
        if key in _NOT_OF_THE_NETWORK:
            continue
        if key == "activation_fn":
            if not isinstance(value, Name) or value.qualname not in _ACTIVATIONS:
                raise NotPlainData(f"activation_fn {value}; supported: {', '.join(_ACTIVATIONS)}")
            kwargs[key] = _ACTIVATIONS[value.qualname]
        elif key == "features_extractor_class":
            if not isinstance(value, Name) or value.qualname not in _EXTRACTORS:
                raise NotPlainData(f"a features extractor that the user wrote: {value}")
        else:
            kwargs[key] = read_plain(value)
    return kwargs


def read_space(value: Any) -> spaces.Space[Any]:
    """Return the space that a pickle of Gymnasium or of the old Gym describes."""
    kind, state = _split_object(value, "gym.spaces.", "gymnasium.spaces.")
    if kind == "Box":
        shape = tuple(state["_shape"] if "_shape" in state else state["shape"])
        dtype = read_dtype(state["dtype"])
        low, high = (read_array(state[name]).reshape(shape).astype(dtype) for name in ("low", "high"))
        return spaces.Box(low, high, shape, dtype.type)
    if kind == "Discrete":
        return spaces.Discrete(int(read_array(state["n"])), start=int(read_array(state.get("start", 0))))
    if kind == "MultiDiscrete":
        return spaces.MultiDiscrete(read_array(state["nvec"]))
    if kind == "MultiBinary":
        return spaces.MultiBinary(read_array(state["n"]).tolist())
    if kind == "Dict":
        parts = state["spaces"].items
        pairs = parts() if callable(parts) else parts.items()
        return spaces.Dict([(str(key), read_space(space)) for key, space in pairs])
    raise NotPlainData(f"a {kind} space")


def _split_object(value: Any, *modules: str) -> tuple[str, dict[str, Any]]:
    """Return the class name and the attributes of an object from one of the modules."""
    if not isinstance(value, Call) or not str(value.function).startswith(modules) or not isinstance(value.state, dict):
        actual, module = getattr(value, "function", value), modules[-1].rstrip(".")
        raise NotPlainData(f"{short_repr(actual)} where an object of {module} is expected")
    return value.function.qualname, value.state


def read_normalization(path: Path) -> SavedNormalization | None:
    """Read a vecnormalize.pkl; None if it does not normalise observations. Raises `ArtifactError` as `read_model`."""
    with _explain_errors(path, "a VecNormalize"):
        content = untrusted.read_bytes(path, LARGEST_MEMBER)
        kind, state = _split_object(pickle_data.read(content), "stable_baselines3.common.vec_env.vec_normalize.")
        if kind != "VecNormalize":
            raise NotPlainData(f"{kind} where VecNormalize is expected")
        if not state.get("norm_obs", True):
            return None
        if (epsilon := float(state.get("epsilon", 1e-8))) != 1e-8:
            raise NotPlainData(f"an epsilon of {epsilon:g}; only Stable-Baselines3's default, 1e-08, is supported")
        statistics = state["obs_rms"]
        parts = statistics if isinstance(statistics, dict) else {"": statistics}
        tensors: dict[str, NDArray[np.float64]] = {}
        for key, part in parts.items():
            _, values = _split_object(part, "stable_baselines3.common.running_mean_std.")
            for name in ("mean", "var"):
                tensors[f"normalize/{key}/{name}"] = read_array(values[name]).astype(np.float64)
        return SavedNormalization(list(parts), tensors, float(state["clip_obs"]))
