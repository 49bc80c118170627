"""Policy files, and policies to run: numpy in, numpy out.

A policy is a `.safetensors` file: tensors, normalisation, and as JSON everything needed to use it. The format is
read without pickle. An exported `.onnx` file is a policy too.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import hashlib
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
from numpy.typing import NDArray
from pydantic import Field

from rlctl.environments.dict_spaces import join, map_parts, split, split_space
from rlctl.environments.info import EnvInfo
from rlctl.environments.named_spec import PolicySpec
from rlctl.environments.named_task import POLICY
from rlctl.environments.spec import UNCHANGED, EnvChanges, EnvSpec
from rlctl.errors import ArtifactError, short_repr
from rlctl.policy.shipped import Provenance
from rlctl.storage import files, untrusted
from rlctl.version import __version__

FORMAT = 1


class Score(pydantic.BaseModel, extra="forbid"):
    """What a policy reached in the evaluation that it was kept for."""

    success: float | None
    mean_return: float


class PolicyInfo(pydantic.BaseModel, extra="forbid"):
    """Everything about a policy but its numbers."""

    format: int = FORMAT
    algo: str
    policy: str
    """SB3's name of the policy class: MlpPolicy, CnnPolicy, MultiInputPolicy, MlpLstmPolicy, ..."""
    policy_kwargs: dict[str, Any] = {}
    clip_observation: float | None = Field(None, gt=0)
    """Clip of normalised observations; None where observations are not normalised."""
    normalized_keys: list[str] = []
    """Which entries of a dict observation are normalised."""
    env: EnvInfo
    """What the environment is."""
    spec: PolicySpec
    """What the environment is made from; of a curriculum in its last stage."""
    stages: list[PolicySpec] = []
    """Stages of the curriculum."""
    training_steps: int = 0
    evaluation: Score | None = None
    """Of the best policy of a run: why it is the best."""
    versions: dict[str, str] = {}
    provenance: Provenance | None = None
    """Of an exported policy."""

    def derive_spec(self, task: str | None = None, changes: EnvChanges = UNCHANGED) -> EnvSpec:
        """Return what this policy was trained for, or another task, with changes."""
        if task is not None and task != self.spec.task:
            return changes.apply(EnvSpec(task, frame_stack=self.spec.frame_stack, time_feature=self.spec.time_feature))
        return changes.apply(dataclasses.replace(self.spec, named_by=POLICY if task is None else ""))

    def check_fits(self, env: EnvInfo, file: Path) -> None:
        """Raise `ArtifactError` if the policy in `file` was made for other spaces than `env` has."""
        if difference := self.env.find_difference(env):
            raise ArtifactError(f"{file}: this policy is not for this task: {difference}")


def collect_versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return dict(_read_versions())


@functools.cache  # each is read from a file, and every checkpoint needs them
def _read_versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "rlctl": __version__}
    for name in ("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy", "pybullet"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def save_policy(path: Path, info: PolicyInfo, tensors: dict[str, NDArray[Any]]) -> None:
    """Write a policy file, whole or not at all; see `encode_policy`."""
    files.write_bytes(path, encode_policy(info, tensors))


def encode_policy(info: PolicyInfo, tensors: dict[str, NDArray[Any]]) -> bytes:
    """Return the content of a policy file.

    `tensors` has the network's under `policy/`, and mean and variance per observation key under `normalize/`.
    """
    from safetensors.numpy import save

    contiguous = {name: np.asarray(value, order="C") for name, value in tensors.items()}
    text = info.model_dump_json()
    return save(contiguous, metadata={"rlctl": text, "sha256": compute_digest(text, contiguous)})


def compute_digest(info: str, tensors: Mapping[str, NDArray[Any]]) -> str:
    """Return the sha256 of what a policy file says: a disk may return other bits, and they load as well."""
    content = hashlib.sha256(info.encode())
    for name, values in sorted(tensors.items()):
        content.update(f"{name} {values.dtype} {values.shape}".encode())
        content.update(np.ascontiguousarray(values).data)
    return content.hexdigest()


def read_info(path: Path) -> PolicyInfo:
    """Read what a policy file says of its policy, without its numbers; raises `ArtifactError` as `read_policy` does."""
    return _read_file(path, tensors=False)[1]


def read_policy(path: Path) -> tuple[PolicyInfo, dict[str, NDArray[Any]]]:
    """Read a policy file; raises `ArtifactError` if it is missing, damaged, not ours or of a newer format."""
    metadata, info, tensors = _read_file(path)
    if "sha256" not in metadata:
        raise ArtifactError(f"{path}: damaged: its metadata has no sha256, which every policy of rlctl has")
    if metadata["sha256"] != compute_digest(metadata["rlctl"], tensors):
        raise ArtifactError(f"{path}: damaged: its sha256 is not the one it was saved with")
    for name, values in tensors.items():
        if not np.isfinite(values).all():
            raise ArtifactError(f"{path}: damaged: {short_repr(name)} is not finite")
    return info, tensors


def _read_file(path: Path, tensors: bool = True) -> tuple[dict[str, str], PolicyInfo, dict[str, NDArray[Any]]]:
    from safetensors import SafetensorError, safe_open

    untrusted.check_safetensors(path)
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            info = parse_info(metadata.get("rlctl"), path)
            return metadata, info, {name: file.get_tensor(name) for name in (file.keys() if tensors else ())}
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as error:
        raise ArtifactError(f"{path}: damaged, or not a .safetensors file: {error}") from None


def parse_info(text: str | None, path: Path) -> PolicyInfo:
    """Check the metadata of a policy; `path` is for the error."""
    if text is None:
        raise ArtifactError(f"{path}: not an rlctl policy: its metadata has no 'rlctl' entry")
    return untrusted.parse_model(text, PolicyInfo, path, "policy")


class Policy(abc.ABC):
    """A policy that can be run, one observation after the other."""

    def __init__(self, info: PolicyInfo) -> None:
        self.info = info
        self.observation_space, self.action_space = info.env.spaces()
        self._parts = {
            key: (space.shape or (), space.dtype) for key, space in split_space(self.observation_space).items()
        }

    @abc.abstractmethod
    def predict(self, observation: Any, *, deterministic: bool = True) -> NDArray[Any]:
        """Return the action for one observation, as the environment takes it.

        A recurrent policy remembers; call `reset` when an episode begins. Raises `ValueError` for an observation of
        another shape.
        """

    @abc.abstractmethod
    def reset(self) -> None:
        """Begin an episode: forget what is remembered."""

    def read_observation(self, observation: Any) -> dict[str, NDArray[Any]]:
        """Return the parts of an observation by key, in their dtypes; raises `ValueError` for another shape."""
        given = split(observation)
        parts = {}
        for key, (shape, dtype) in self._parts.items():
            value = np.asarray(given[key], dtype) if key in given else None
            if value is not None and value.dtype.kind == "u" and (odd := value != given[key]).any():
                raise ValueError(f"observation has {np.asarray(given[key])[odd][0]:g}, the policy expects {dtype}")
            if value is None or value.shape != shape:
                expected = join({key: shape for key, (shape, _) in self._parts.items()})
                raise ValueError(
                    f"observation of shape {map_parts(np.shape, observation)}, the policy expects {expected}"
                    + _describe_additions(self.info.spec)
                )
            parts[key] = value
        return parts

    def try_once(self, *, deterministic: bool = True) -> None:
        """Act once, on a made-up observation; raises `ValueError` for an action that the action space cannot have.

        Whatever else is wrong with a file that somebody has written by hand raises here too.
        """
        spaces = split_space(self.observation_space).items()
        zeros = {key: np.full(space.shape or (), getattr(space, "start", 0), space.dtype) for key, space in spaces}
        action = self.predict(join(zeros), deterministic=deterministic)
        self.reset()
        if action.shape != (self.action_space.shape or ()):
            raise ValueError(
                f"its actions have shape {action.shape}, those of its action space {self.action_space.shape}"
            )
        if not np.isfinite(action).all():
            raise ValueError("its actions are not finite")


def _describe_additions(spec: EnvSpec) -> str:
    """Say what a policy observes beyond what its task returns, and where that comes from."""
    added = ["the part of the episode that is left"] if spec.time_feature else []
    if spec.frame_stack > 1:
        added.append(f"{spec.frame_stack} frames")
    return f", with {' and '.join(added)}, as policy.info.spec.make() returns it" if added else ""


def load_policy(path: Path) -> Policy:
    """Load a `.safetensors` or an exported `.onnx` file, without torch; raises `ArtifactError` if it is not one."""
    if path.suffix == ".onnx":
        from rlctl.policy.onnx_policy import OnnxPolicy

        return OnnxPolicy.load(path)
    from rlctl.policy.players.policy_player import NumpyPolicy

    return NumpyPolicy.load(path)
