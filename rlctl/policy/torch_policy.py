"""SB3's networks, and policies that act with them, for comparison with exports. Imports torch."""

from pathlib import Path
from typing import Any, Self

import sb3_contrib
import stable_baselines3
import torch
from gymnasium import spaces
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecTransposeImage
from threadpoolctl import threadpool_limits

from rlctl.environments.dict_spaces import Observations, join, split
from rlctl.errors import ArtifactError, short_repr
from rlctl.policy import own_modules
from rlctl.policy.actor import Array, Rows, as_stored
from rlctl.policy.file import PolicyFile, PolicyInfo, list_actor_tensors
from rlctl.policy.network import read_normalization
from rlctl.policy.policy import FileActor, Policy
from rlctl.policy.xqc import XQC

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "ppo": stable_baselines3.PPO,
    "a2c": stable_baselines3.A2C,
    "sac": stable_baselines3.SAC,
    "td3": stable_baselines3.TD3,
    "ddpg": stable_baselines3.DDPG,
    "dqn": stable_baselines3.DQN,
    "tqc": sb3_contrib.TQC,
    "crossq": sb3_contrib.CrossQ,
    "xqc": XQC,
    "recurrent_ppo": sb3_contrib.RecurrentPPO,
}

ACTIVATIONS: dict[str, type[torch.nn.Module]] = {
    "tanh": torch.nn.Tanh,
    "relu": torch.nn.ReLU,
    "elu": torch.nn.ELU,
    "silu": torch.nn.SiLU,
}

_LEFT_OUT = (
    *("observation_space", "action_space", "lr_schedule", "optimizer_class", "optimizer_kwargs"),
    *("features_extractor_class", "normalize_images", "dist_kwargs"),
)
"""Arguments that are not plain data and are not needed to act."""


def pin_threads() -> None:
    """Make torch and NumPy use one thread: the last bits of a result depend on the number of threads."""
    torch.set_num_threads(1)
    threadpool_limits(1, "blas")


def policy_name(algo: str, observation_space: spaces.Space[Any]) -> str:
    """Return SB3's name of the policy for an observation space."""
    kind = "Cnn" if is_image_space(observation_space) else "Mlp"
    if isinstance(observation_space, spaces.Dict):
        kind = "MultiInput"
    return f"{kind}{'Lstm' if algo == 'recurrent_ppo' else ''}Policy"


def network_space(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """Return the observation space as SB3's networks see it: images with channels first."""
    if isinstance(space, spaces.Dict):
        # Pairs, because Gymnasium sorts the keys of a plain dict, and the network depends on their order.
        return spaces.Dict([(key, network_space(value)) for key, value in space.spaces.items()])
    if isinstance(space, spaces.Box) and is_image_space(space) and not is_image_space_channels_first(space):
        return VecTransposeImage.transpose_space(space)
    return space


def is_own(cls: type) -> bool:
    """Return whether a policy or a features extractor is a user's own, not one of Stable-Baselines3."""
    return cls.__module__.partition(".")[0] not in ("stable_baselines3", "sb3_contrib", "rlctl")


def describe_network(policy: BasePolicy) -> dict[str, Any]:
    """Return the constructor arguments of a network as plain data, for `build_network`."""
    described = {}
    arguments = {**policy._get_constructor_parameters(), **_list_missing_arguments(policy)}
    if is_own(type(policy)):  # its constructor may have others
        own: Any = policy.own_arguments
        arguments = {**own, "policy_class": type(policy)}
    for name, value in arguments.items():
        if name in ("policy_class", "features_extractor_class") and is_own(value):
            value = own_modules.describe_class(value)
        elif name in _LEFT_OUT or value is None:
            continue
        if name == "activation_fn":
            names = [activation for activation, cls in ACTIVATIONS.items() if cls is value]
            value = names[0] if names else own_modules.describe_class(value)
        described[name] = value
    return described


def _list_missing_arguments(policy: BasePolicy) -> dict[str, Any]:
    """Return arguments that change a network but are missing in SB3's `_get_constructor_parameters`."""
    missing: dict[str, Any] = {}
    if hasattr(policy, "share_features_extractor"):
        missing["share_features_extractor"] = policy.share_features_extractor
    if isinstance(policy, RecurrentActorCriticPolicy):
        lstm = policy.lstm_actor
        missing |= {"lstm_hidden_size": lstm.hidden_size, "n_lstm_layers": lstm.num_layers}
        missing |= {name: getattr(policy, name) for name in ("shared_lstm", "enable_critic_lstm", "lstm_kwargs")}
    return missing


def build_network(info: PolicyInfo) -> BasePolicy:
    """Build an untrained network from a policy's description; raises `ArtifactError` for an unknown one."""
    observation_space, action_space = info.env.spaces()
    if info.algo not in ALGORITHMS:
        raise ArtifactError(f"policy for an unknown algorithm {info.algo!r}")
    cls: type[BasePolicy] | None = ALGORITHMS[info.algo].policy_aliases.get(info.policy)
    if cls is None:
        raise ArtifactError(f"policy of an unknown kind {info.policy!r} for {info.algo}")
    # Acting needs no optimiser, and torch's optimisers import its compiler (0.8 s).
    kwargs: dict[str, Any] = {"optimizer_class": lambda parameters, **settings: None, **info.policy_kwargs}
    if "activation_fn" in kwargs:
        name = kwargs["activation_fn"]
        kwargs["activation_fn"] = own_modules.find_class(name) if isinstance(name, dict) else ACTIVATIONS[name]
    if "features_extractor_class" in kwargs:
        kwargs["features_extractor_class"] = own_modules.find_class(kwargs["features_extractor_class"])
    if "policy_class" in kwargs:
        cls = own_modules.find_class(kwargs.pop("policy_class"))
        del kwargs["optimizer_class"]  # a user's own constructor may not have it
    return cls(network_space(observation_space), action_space, lr_schedule=lambda _: 0.0, **kwargs)


class TorchActor(FileActor):
    """A policy file that acts with SB3's network, as in training. Deterministic.

    A recurrent policy must act on the same rows in every step of their episodes.
    """

    def __init__(self, policy: PolicyFile, network: BasePolicy) -> None:
        self.info, self.file = policy.info, policy
        self.network = network
        self._normalize = read_normalization(policy)
        self.is_recurrent = policy.info.algo == "recurrent_ppo"
        self._state: Any = None
        network.set_training_mode(False)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a policy file; raises `ArtifactError` if it is not one, or its tensors do not fit its description."""
        policy = PolicyFile.read(path)
        try:
            return cls._build(policy)
        except ArtifactError as error:
            raise ArtifactError(f"{path}: {error}") from None
        except Exception as error:  # any exception from torch or SB3: the description is unchecked until here
            problem = short_repr(str(error), 200)
            raise ArtifactError(f"{path}: its tensors do not fit its description: {problem}") from None

    @classmethod
    def _build(cls, policy: PolicyFile) -> Self:
        network = build_network(policy.info)
        weights = policy.weights
        if policy.info.privileged:  # the critic's have other inputs than this network
            own = policy.actor_only().weights
            weights = {name: value for name, value in own.items() if "mlp_extractor.value_net" not in name}
        state = {name: torch.from_numpy(value.copy()) for name, value in weights.items()}
        mismatch = network.load_state_dict(state, strict=False)
        # A shipped policy has no critic, and acting needs none.
        missing = list_actor_tensors(policy.info.algo, [f"policy/{name}" for name in mismatch.missing_keys])
        if missing or mismatch.unexpected_keys:
            raise ValueError(f"tensors missing: {missing}, unknown: {mismatch.unexpected_keys}")
        actor = cls(policy, network)
        Policy(actor).try_once()
        return actor

    def normalize(self, observations: Observations) -> Observations:
        """Return observations, normalised."""
        parts = split(observations)
        changed = {key: normalize(parts[key]) for key, normalize in self._normalize.items()}
        return join({**parts, **changed})

    def begin(self, rows: Rows) -> None:
        """Forget the recurrent states of all rows."""
        self._state = None

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the actions for a batch of observations."""
        actions, self._state = self.network.predict(self.normalize(observations), self._state, deterministic=True)
        return as_stored(actions), actions
