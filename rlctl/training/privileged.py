"""Networks whose critic sees more than the actor: asymmetric actor-critic.

L. Pinto et al., Asymmetric Actor Critic for Image-Based Robot Learning, 2017, https://arxiv.org/abs/1710.06542.

An observation of the training has the actor's elements first and the critic's own after them. Networks of
Stable-Baselines3 get all of it; their features extractors select what each of them sees.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor
from stable_baselines3.sac.policies import SACPolicy

from rlctl.play.shared_arrays import CRITIC
from rlctl.policy.xqc import XqcPolicy


def widen_space(space: spaces.Space[Any], privileged: int) -> spaces.Space[Any]:
    """Return the space of observations that the critic sees: those of the actor, then so many unbounded numbers."""
    if not privileged:
        return space
    assert isinstance(space, spaces.Box)  # workers refuse others
    own = np.full(privileged, np.inf, np.float32)
    return spaces.Box(np.concatenate([space.low, -own]), np.concatenate([space.high, own]), dtype=np.float32)


def widen(parts: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return observations by key with the critic's own elements after the actor's, along the last axis."""
    if CRITIC not in parts:
        return parts
    return {key: np.concatenate([rows, parts[CRITIC]], axis=-1) for key, rows in parts.items() if key != CRITIC}


class ActorColumns(BaseFeaturesExtractor):
    """Extracts the features of the actor's part of an observation."""

    def __init__(self, space: spaces.Box, inner: BaseFeaturesExtractor, size: int) -> None:
        super().__init__(space, inner.features_dim)
        self.inner, self.size = inner, size

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return features of shape (rows, features)."""
        return self.inner(observations[:, : self.size])


class CriticColumns(BaseFeaturesExtractor):
    """Extracts the features of the actor's part, and adds the critic's own elements."""

    def __init__(self, space: spaces.Box, inner: BaseFeaturesExtractor, size: int) -> None:
        super().__init__(space, inner.features_dim + space.shape[0] - size)
        self.inner, self.size = inner, size

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return features of shape (rows, features)."""
        return torch.cat([self.inner(observations[:, : self.size]), observations[:, self.size :]], dim=1)


class Privileged:
    """Makes the features extractors of a policy of Stable-Baselines3, of whose observation the actor sees a part."""

    privileged: Mapping[str, int]  # sizes of what only the critic sees, by name
    observation_space: Any

    @property
    def actor_size(self) -> int:
        """Number of elements that the actor sees."""
        return int(self.observation_space.shape[0]) - sum(self.privileged.values())

    def make_inner(self) -> BaseFeaturesExtractor:
        """Return an extractor for the actor's part of an observation."""
        policy: Any = self
        low, high = self.observation_space.low, self.observation_space.high
        space = spaces.Box(low[: self.actor_size], high[: self.actor_size], dtype=np.float32)
        return policy.features_extractor_class(space, **policy.features_extractor_kwargs)

    def make_actor_columns(self) -> ActorColumns:
        """Return the actor's extractor."""
        return ActorColumns(self.observation_space, self.make_inner(), self.actor_size)

    def make_critic_columns(self, inner: BaseFeaturesExtractor | None = None) -> CriticColumns:
        """Return the critic's extractor; `inner` is one that it shares with the actor."""
        return CriticColumns(self.observation_space, inner or self.make_inner(), self.actor_size)


class _PrivilegedOnPolicy(Privileged):
    """What the policies of on-policy algorithms share."""

    def __init__(
        self, *args: Any, privileged: Mapping[str, int], share_features_extractor: bool = True, **kwargs: Any
    ) -> None:
        if kwargs.get("shared_lstm"):
            raise ValueError("shared_lstm: the critic sees more than the actor, so they share no LSTM")
        self.privileged, self._shares = privileged, share_features_extractor
        # For SB3 they are two extractors, because they return different features.
        super().__init__(*args, **{**kwargs, "share_features_extractor": False})

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Return the actor's extractor; `set_critic_columns` makes the critic's."""
        return self.make_actor_columns()

    def set_critic_columns(self) -> None:
        """Replace the critic's extractor, which SB3 has made as the actor's."""
        policy: Any = self
        inner = policy.pi_features_extractor.inner if self._shares else None
        policy.vf_features_extractor = self.make_critic_columns(inner)


class PrivilegedActorCriticPolicy(_PrivilegedOnPolicy, ActorCriticPolicy):
    """PPO's and A2C's networks."""

    def _build_mlp_extractor(self) -> None:
        self.set_critic_columns()
        arguments = self.net_arch, self.activation_fn, self.device
        self.mlp_extractor = MlpExtractor(self.pi_features_extractor.features_dim, *arguments)
        critic = MlpExtractor(self.vf_features_extractor.features_dim, *arguments)
        self.mlp_extractor.value_net = critic.value_net


class PrivilegedRecurrentPolicy(_PrivilegedOnPolicy, RecurrentActorCriticPolicy):
    """Recurrent PPO's networks; each has its own LSTM, or the critic has none."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # SB3 has made the critic's for the actor's features.
        size, hidden = self.vf_features_extractor.features_dim, self.lstm_output_dim
        if self.lstm_critic is None:
            self.critic = torch.nn.Linear(size, hidden)
        else:
            self.lstm_critic = torch.nn.LSTM(size, hidden, num_layers=self.lstm_actor.num_layers, **self.lstm_kwargs)
        rate = self.optimizer.param_groups[0]["lr"]
        self.optimizer = self.optimizer_class(self.parameters(), lr=rate, **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _build_mlp_extractor(self) -> None:
        self.set_critic_columns()
        super()._build_mlp_extractor()


class _PrivilegedOffPolicy(Privileged):
    """What the policies of off-policy algorithms share."""

    def __init__(
        self, *args: Any, privileged: Mapping[str, int], share_features_extractor: bool = False, **kwargs: Any
    ) -> None:
        if share_features_extractor:
            raise ValueError("share_features_extractor: the critic sees more than the actor, so they share none")
        self.privileged = privileged
        super().__init__(*args, **kwargs)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Return a critic's extractor; `make_actor` makes the actor's."""
        return self.make_critic_columns()

    def make_actor(self, features_extractor: Any = None) -> Any:
        """Return the actor, which sees its own part."""
        parent: Any = super()
        return parent.make_actor(self.make_actor_columns())


class PrivilegedSACPolicy(_PrivilegedOffPolicy, SACPolicy):
    """SAC's networks."""


class PrivilegedTQCPolicy(_PrivilegedOffPolicy, TQCPolicy):
    """TQC's networks."""


class PrivilegedXqcPolicy(_PrivilegedOffPolicy, XqcPolicy):
    """XQC's networks."""


POLICIES: dict[str, Any] = {
    "ppo": PrivilegedActorCriticPolicy,
    "a2c": PrivilegedActorCriticPolicy,
    "recurrent_ppo": PrivilegedRecurrentPolicy,
    "sac": PrivilegedSACPolicy,
    "tqc": PrivilegedTQCPolicy,
    "xqc": PrivilegedXqcPolicy,
}
"""The policy of each algorithm whose critic may see more than the actor."""


def name_as_sb3(name: str) -> str:
    """Return the name that a tensor of a policy has where its critic sees what the actor sees, as in policy files."""
    return name.replace("_extractor.inner.", "_extractor.")


def read_privileged(policy: Any) -> dict[str, int]:
    """Return the sizes of what only the critic of a policy sees, by name; empty if it sees what the actor sees."""
    return dict(policy.privileged) if has_privileged_critic(policy) else {}


def has_privileged_critic(policy: Any) -> bool:
    """Return whether the critic of a policy sees more than its actor."""
    return isinstance(policy, Privileged)
