"""Policy files that act in this process with NumPy, bit for bit as in workers. Imports no torch."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import join, split_space
from rlctl.errors import ArtifactError, UsageError, short_repr
from rlctl.policy.file import PolicyFile
from rlctl.policy.players.player import Exploration
from rlctl.policy.players.policy_player import PolicyPlayer
from rlctl.policy.policy import Policy

_MEAN, _SAMPLE = Exploration(), Exploration(stochastic=True)


class NumpyPolicy(Policy):
    """A policy file that acts in this process, bit for bit as in workers."""

    def __init__(self, policy: PolicyFile) -> None:
        super().__init__(policy.info)
        self.player = PolicyPlayer(policy)
        self.reset()

    def predict(self, observation: Any, *, deterministic: bool = True) -> NDArray[Any]:
        """Return the action for one observation; `deterministic=False` samples it, with new noise in every episode."""
        self.player.explore(_MEAN if deterministic else _SAMPLE)
        if self._step == 0:
            self.player.begin_segment(self._seed, 0)
        action = self.player.act(join(self.read_observation(observation)), self._seed, self._step)[1]
        self._step += 1
        return np.asarray(action)

    def reset(self) -> None:
        """Begin an episode: forget the recurrent state."""
        self._seed, self._step = int(np.random.SeedSequence().generate_state(1)[0]), 0
        if self.player.state is not None:
            self.player.state[:] = 0.0


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
        player = NumpyPolicy(policy)
        player.try_once()
        player.try_once(deterministic=False)
    except UsageError:
        raise
    except Exception as error:  # any exception from NumPy: the description is unchecked until here
        text = short_repr(str(error), 200)
        raise ArtifactError(f"{policy.path}: its tensors do not fit its description: {text}") from None
    return policy


def load_policy(path: Path) -> Policy:
    """Load a `.safetensors` or an exported `.onnx` file, without torch; raises `ArtifactError` if it is not one."""
    if path.suffix == ".onnx":
        from rlctl.policy.onnx_policy import OnnxPolicy

        return OnnxPolicy.load(path)
    return NumpyPolicy(check_playable(PolicyFile.read(path)).actor_only())
