"""Policy files and exported files as actors, and as policies of the Python API; without torch."""

from pathlib import Path

from rlctl.environments.dict_spaces import split_space
from rlctl.errors import ArtifactError, UsageError, short_repr
from rlctl.policy.file import PolicyFile
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.policy import FileActor, Policy

LIBRARY_SUFFIX = ".so"


def load_actor(path: Path, count: int = 1) -> FileActor:
    """Load a `.safetensors`, an exported `.onnx` or a compiled `.so` file, to act in `count` environments.

    Raises `ArtifactError` if it is not one.
    """
    if path.suffix == ".onnx":
        from rlctl.policy.onnx_policy import OnnxActor  # only here: it imports onnxruntime

        return OnnxActor.load(path, count)
    if path.suffix == LIBRARY_SUFFIX:
        from rlctl.policy.c_policy import CActor

        return CActor.load(path, count)
    return NumpyActor(check_playable(PolicyFile.read(path)).actor_only(), count)


def load_policy(path: Path) -> Policy:
    """Load a `.safetensors` or an exported `.onnx` file; raises `ArtifactError` if it is not one."""
    return Policy(load_actor(path))


def check_playable(policy: PolicyFile) -> PolicyFile:
    """Act once on an observation of zeros, and return the policy.

    Raises `ArtifactError` if the tensors do not fit their description.
    """
    info, tensors = policy.info, policy.tensors
    try:
        shapes = {key: space.shape for key, space in split_space(info.env.spaces()[0]).items()}
        for key in info.normalized_keys:
            for name in (f"normalize/{key}/mean", f"normalize/{key}/var"):
                if tensors[name].shape != shapes[key]:
                    raise ValueError(f"{name} has shape {tensors[name].shape}, the observation {shapes[key]}")
        playable = Policy(NumpyActor(policy))
        playable.try_once()
        playable.try_once(deterministic=False)
    except UsageError:
        raise
    except Exception as error:  # any exception from NumPy: the description is unchecked until here
        text = short_repr(str(error), 200)
        raise ArtifactError(f"{policy.path}: its tensors do not fit its description: {text}") from None
    return policy
