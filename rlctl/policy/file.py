"""Policy files: `.safetensors`, without pickle, with the network, the normalisation, and JSON that describes them."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
import pydantic
from numpy.typing import NDArray
from pydantic import Field

from rlctl.environments import named_task, registry
from rlctl.environments.info import EnvInfo
from rlctl.environments.named_task import POLICY
from rlctl.environments.spec import UNCHANGED, EnvChanges, EnvSpec, PolicySpec
from rlctl.errors import ArtifactError, UsageError, short_repr
from rlctl.policy.shipped import Provenance
from rlctl.storage import files, untrusted

FORMAT = 1

SQUASHED_GAUSSIAN = ("sac", "tqc", "crossq", "xqc")
DETERMINISTIC = ("td3", "ddpg")  # algorithms whose policy has no distribution to sample from
ACTOR_CRITIC = (*SQUASHED_GAUSSIAN, *DETERMINISTIC)  # algorithms whose policy has a separate `actor`
GRAPH = "graph/actor"  # the tensor that holds a user's network, an ONNX graph as bytes; see `rlctl.policy.onnx_policy`
OPSET = 17  # of the ONNX graphs that rlctl writes; onnxruntime 1.12 and newer read it


class Score(pydantic.BaseModel, extra="forbid"):
    """The score of the evaluation that made a policy the best of its run."""

    success: float | None
    mean_return: float


class PolicyInfo(pydantic.BaseModel, extra="forbid"):
    """Everything about a policy except its tensors."""

    format: int = FORMAT
    algo: str
    policy: str  # SB3's name of the policy class: MlpPolicy, CnnPolicy, MultiInputPolicy, MlpLstmPolicy, ..
    policy_kwargs: dict[str, Any] = {}
    clip_observation: float | None = Field(None, gt=0)
    """Clip of normalised observations; None where observations are not normalised."""
    normalized_keys: list[str] = []
    """Keys of the normalised parts of a dict observation; `""` for any other observation."""
    privileged: dict[str, int] = {}
    """Size of each observation that only the critic saw in training, by name."""
    env: EnvInfo
    spec: PolicySpec  # how to build the environment; for a curriculum, its last stage
    stages: list[PolicySpec] = []  # stages of the curriculum
    training_steps: int = 0
    evaluation: Score | None = None  # the score that made it the best policy of its run; None for any other policy
    versions: dict[str, str] = {}
    origin: dict[str, str] = {}
    """`distribution` and `version` of the installed task in which it was trained; empty for any other task."""
    provenance: Provenance | None = None  # where an exported policy comes from; None for any other policy

    def derive_spec(self, task: str | None = None, changes: EnvChanges = UNCHANGED) -> EnvSpec:
        """Return the spec of the environment it was trained in, or of another task, with `changes`.

        Raises `UsageError` if its own task is of a package that is not installed.
        """
        if task is not None and task != self.spec.task:
            from rlctl.recipe.recipe_files import make_spec  # few commands play another task

            return changes.apply(make_spec(task).observe_as(self.spec))
        self._check_installed()
        own = self.spec.replace_missing_engine()
        # Policies of older versions may have the level of the last stage of their training.
        own = dataclasses.replace(own, level=1.0, named_by=POLICY if task is None else "")
        return changes.apply(own)

    def _check_installed(self) -> None:
        task = self.spec.task
        if not registry.is_missing(task):
            return
        named_task.check_source(task, POLICY)  # the name may have been written by anyone
        origin = self.origin or (self.provenance.origin if self.provenance is not None else {})
        package = short_repr(" ".join(origin.values()))
        of_package = f" of the package {package}" if package else ""
        raise UsageError(
            f"this policy was trained on the task {task!r}{of_package}, which is not installed\n"
            f"install {package or 'its package'} from its folder or wheel: pip install PATH; what is installed: "
            "rlctl tasks"
        )

    def check_fits(self, env: EnvInfo, file: Path) -> None:
        """Raise `ArtifactError` if the policy in `file` was made for other spaces than `env` has."""
        if difference := self.env.find_difference(env):
            raise ArtifactError(f"{file}: this policy is not for this task: {difference}")


Tensors = Mapping[str, NDArray[Any]]
"""Arrays by name: the network's under `policy/`, mean and variance per observation key under `normalize/`."""


@dataclasses.dataclass(frozen=True, eq=False)
class PolicyFile:
    """The content of a policy file: a description and tensors."""

    info: PolicyInfo
    tensors: Tensors = dataclasses.field(repr=False)
    path: Path | None = None  # the file that was read

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a policy file; raises `ArtifactError` if it is missing, damaged, not from rlctl or of a newer format."""
        metadata, info, tensors = _read(path)
        if metadata.get("sha256") != compute_digest(metadata["rlctl"], tensors):
            raise ArtifactError(f"{path}: damaged: its content does not match its sha256")
        for name, values in tensors.items():
            if not np.isfinite(values).all():
                raise ArtifactError(f"{path}: damaged: {short_repr(name)} is not finite")
        return cls(info, tensors, path)

    @staticmethod
    def read_info(path: Path) -> PolicyInfo:
        """Read only the description of a policy file; raises `ArtifactError` as `read` does."""
        return _read(path, tensors=False)[1]

    @property
    def weights(self) -> dict[str, NDArray[Any]]:
        """The network's tensors, by the names of SB3's `state_dict`."""
        prefix = "policy/"
        return {name.removeprefix(prefix): values for name, values in self.tensors.items() if name.startswith(prefix)}

    def actor_only(self) -> Self:
        """Return the policy with only the tensors of the actor and of the normalisation."""
        names = list_actor_tensors(self.info.algo, self.tensors)
        return dataclasses.replace(self, tensors={name: self.tensors[name] for name in names})

    def with_info(self, **changes: Any) -> Self:
        """Return the policy with some fields of its description changed."""
        return dataclasses.replace(self, info=self.info.model_copy(update=changes))

    def encode(self) -> bytes:
        """Return the content of the file; equal policies have equal bytes."""
        from safetensors.numpy import save

        contiguous = {name: np.asarray(value, order="C") for name, value in self.tensors.items()}
        text = self.info.model_dump_json()
        content = save(contiguous, metadata={"rlctl": text, "sha256": compute_digest(text, contiguous)})
        # The header, after 8 bytes with its size, has the metadata in random order.
        size = int.from_bytes(content[:8], "little")
        header = json.dumps(json.loads(content[8 : 8 + size]), sort_keys=True, separators=(",", ":")).encode()
        header += b" " * (-len(header) % 8)
        return len(header).to_bytes(8, "little") + header + content[8 + size :]

    def write(self, path: Path) -> None:
        """Write the file atomically."""
        files.write_bytes(path, self.encode())


def list_actor_tensors(algo: str, names: Iterable[str]) -> list[str]:
    """Return the names of the tensors that acting needs: those of the actor and of the normalisation."""
    names = list(names)
    # A user's policy may have any names in its `mlp_extractor`.
    trunk = "mlp_extractor." if GRAPH in names else "mlp_extractor.policy_net."
    actor: tuple[str, ...] = ("pi_features_extractor.", trunk, "action_net.", "log_std", "lstm_actor.")
    if algo in ACTOR_CRITIC or algo == "dqn":
        actor = ("q_net." if algo == "dqn" else "actor.",)
    prefixes = (GRAPH, "normalize/", *(f"policy/{prefix}" for prefix in actor))
    return [name for name in names if name.startswith(prefixes)]


def compute_digest(info: str, tensors: Tensors) -> str:
    """Return the sha256 of a policy file's content, to detect damage with which the file still loads."""
    content = hashlib.sha256(info.encode())
    for name, values in sorted(tensors.items()):
        content.update(f"{name} {values.dtype} {values.shape}".encode())
        content.update(np.ascontiguousarray(values).data)
    return content.hexdigest()


def _read(path: Path, tensors: bool = True) -> tuple[dict[str, str], PolicyInfo, dict[str, NDArray[Any]]]:
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
    """Return the checked metadata of a policy; raises `ArtifactError`, which names `path`."""
    if text is None:
        raise ArtifactError(f"{path}: not an rlctl policy: its metadata has no 'rlctl' entry")
    return untrusted.parse_model(text, PolicyInfo, path, "policy")
