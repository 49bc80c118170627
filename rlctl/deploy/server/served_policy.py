"""Policy files as a server uses them: loaded and tried once, acting for many clients, each with a state of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError
from rlctl.policy.file import DETERMINISTIC, PolicyFile, PolicyInfo
from rlctl.policy.network import Network
from rlctl.policy.numpy_policy import NumpyPolicy, check_playable
from rlctl.policy.policy import Policy


@dataclasses.dataclass(frozen=True, eq=False)
class ServedPolicy:
    """A policy that a server acts with."""

    file: Path
    info: PolicyInfo
    make_actor: Callable[[], Policy]
    """Returns what acts for one client: a recurrent policy remembers."""
    network: Network | None = None
    """None of an ONNX file, which has nothing but the action."""

    def measure_spread(self, observation: Any) -> float | None:
        """Return the mean standard deviation of the actions that were trained with; None where there is none."""
        network, algo = self.network, self.info.algo
        if network is None or algo in (*DETERMINISTIC, "dqn") or self.info.policy_kwargs.get("use_sde"):
            return None
        if network.log_std is not None:
            return float(np.exp(network.log_std).mean())
        if network.lstm is not None or self.info.env.action_space["type"] != "Box":
            return None
        return float(network.compute_std(network.compute_latent(observation)).mean())

    def check_replaces(self, other: EnvInfo) -> None:
        """Raise `ArtifactError` if this policy cannot take the place of one for another environment."""
        own = self.info.env
        difference = own.find_difference(other, "the served policy's")
        if difference is None and list(own.observation_sizes.items()) != list(other.observation_sizes.items()):
            difference = "its observation has other names, or another order"
        if difference is None and own.control_dt != other.control_dt:
            difference = f"its control_dt is {own.control_dt} s, the served policy's {other.control_dt} s"
        if difference is not None:
            raise ArtifactError(f"{self.file.name}: this policy cannot replace the one that is served: {difference}")


def load_served_policy(file: Path) -> ServedPolicy:
    """Load a `.safetensors` or `.onnx` file and act once; raises `ArtifactError` for what is not a sound policy."""
    if file.suffix == ".onnx":
        from rlctl.policy.onnx_policy import OnnxPolicy  # only here: it imports onnxruntime

        policy = OnnxPolicy.load(file)
        return ServedPolicy(file, policy.info, lambda: OnnxPolicy(policy.info, policy.session))
    actor = check_playable(PolicyFile.read(file)).actor_only()
    return ServedPolicy(file, actor.info, lambda: NumpyPolicy(actor), Network(actor))
