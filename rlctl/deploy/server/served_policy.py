"""A policy that is loaded once and acts for many clients, each with its own recurrent state."""

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
    """The policy of a server."""

    file: Path
    info: PolicyInfo
    make_actor: Callable[[], Policy]  # returns the policy of one client, with its own recurrent state
    network: Network | None = None  # None for an ONNX file, which outputs only the action

    def measure_spread(self, observation: Any) -> float | None:
        """Return the mean standard deviation of the stochastic policy's actions; None if the policy has none."""
        network, algo = self.network, self.info.algo
        if network is None or algo in (*DETERMINISTIC, "dqn") or self.info.policy_kwargs.get("use_sde"):
            return None
        if network.log_std is not None:
            return float(np.exp(network.log_std).mean())
        if network.lstm is not None or self.info.env.action_space["type"] != "Box":
            return None
        return float(network.compute_std(network.compute_latent(observation)).mean())

    def check_replaces(self, other: EnvInfo) -> None:
        """Raise `ArtifactError` if this policy cannot replace a policy for the environment `other`."""
        own = self.info.env
        difference = own.find_difference(other, "the served policy's")
        if difference is None and list(own.observation_sizes.items()) != list(other.observation_sizes.items()):
            difference = "its observation has different names or a different order"
        if difference is None and own.control_dt != other.control_dt:
            difference = f"its control_dt is {own.control_dt} s, the served policy's {other.control_dt} s"
        if difference is not None:
            raise ArtifactError(f"{self.file.name}: this policy cannot replace the served one: {difference}")


def load_served_policy(file: Path) -> ServedPolicy:
    """Load a `.safetensors` or `.onnx` file and act once; raises `ArtifactError` for an invalid policy."""
    if file.suffix == ".onnx":
        from rlctl.policy.onnx_policy import OnnxPolicy  # only here: it imports onnxruntime

        policy = OnnxPolicy.load(file)
        return ServedPolicy(file, policy.info, lambda: OnnxPolicy(policy.info, policy.session))
    actor = check_playable(PolicyFile.read(file)).actor_only()
    return ServedPolicy(file, actor.info, lambda: NumpyPolicy(actor), Network(actor))
