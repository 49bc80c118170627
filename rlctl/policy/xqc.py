"""XQC in the form of sb3-contrib's algorithms: CrossQ whose critics are categorical and have weights of unit norm.

D. Palenicek et al., XQC: Well-conditioned Optimization Accelerates Deep Reinforcement Learning, 2025,
https://arxiv.org/abs/2509.25174. Unlike there, the actor, the target entropy and the order of layers are CrossQ's, and
there are no target networks.
"""

from collections import defaultdict
from typing import Any, ClassVar

import numpy as np
import torch
from sb3_contrib import CrossQ
from sb3_contrib.crossq.policies import CrossQCritic, CrossQPolicy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor
from torch import Tensor, nn
from torch.nn import functional


class XqcCritic(CrossQCritic):
    """Critics that estimate the distribution of the return: probabilities of `n_atoms` from `v_min` to `v_max`."""

    support: Tensor

    def __init__(self, *args: Any, n_atoms: int, v_min: float, v_max: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for network in self.q_networks:
            assert isinstance(network, nn.Sequential)
            head: Any = network[-1]
            network[-1] = nn.Linear(head.in_features, n_atoms)
        self.register_buffer("support", torch.linspace(v_min, v_max, n_atoms), persistent=False)
        self.project_weights()

    @torch.no_grad()
    def project_weights(self) -> None:
        """Scale the weights into each unit to the norm 1; those of a hidden unit with its bias."""
        for network in self.q_networks:
            *hidden, head = (module for module in network.children() if isinstance(module, nn.Linear))
            for linear in hidden:
                factor = (linear.weight.square().sum(1) + linear.bias.square()).rsqrt_()
                linear.weight.mul_(factor[:, None])
                linear.bias.mul_(factor)
            head.weight.div_(head.weight.norm(dim=1, keepdim=True))

    def compute_logits(self, obs: Any, actions: Tensor) -> Tensor:
        """Return the logarithms of the probabilities, not normalized; shape (critics, batch, atoms)."""
        return torch.stack(super().forward(obs, actions))

    def compute_values(self, logits: Tensor) -> Tensor:
        """Return the expected returns, shape (critics, batch, 1)."""
        return (logits.softmax(-1) * self.support).sum(-1, keepdim=True)

    def forward(self, obs: Any, actions: Tensor) -> tuple[Tensor, ...]:
        """Return each critic's expected return, shape (batch, 1)."""
        return tuple(self.compute_values(self.compute_logits(obs, actions)))

    def project(self, probabilities: Tensor, returns: Tensor) -> Tensor:
        """Move each probability from its return to the nearest two atoms; shape (batch, atoms) each."""
        v_min, v_max, last = self.support[0], self.support[-1], len(self.support) - 1
        places = (returns.clamp(v_min, v_max) - v_min) * (last / (v_max - v_min))
        below = places.floor().clamp(0, last - 1)
        share, index = places - below, below.long()
        projected = torch.zeros_like(probabilities)
        projected.scatter_add_(1, index, probabilities * (1 - share))
        return projected.scatter_add_(1, index + 1, probabilities * share)


class XqcPolicy(CrossQPolicy):
    """The actor of CrossQ, and categorical critics."""

    critic: XqcCritic

    def __init__(
        self,
        *args: Any,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        n_atoms: int = 101,
        v_min: float = -5.0,
        v_max: float = 5.0,
        **kwargs: Any,
    ) -> None:
        self._atoms: dict[str, Any] = {"n_atoms": n_atoms, "v_min": v_min, "v_max": v_max}
        kwargs["net_arch"] = net_arch or [256, 256]
        super().__init__(*args, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | self._atoms

    def make_critic(self, features_extractor: Any = None) -> XqcCritic:
        """Return the critics."""
        arguments = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return XqcCritic(**arguments, **self._atoms).to(self.device)


class XqcMultiInputPolicy(XqcPolicy):
    """The same for dictionaries."""

    def __init__(self, *args: Any, features_extractor_class: Any = CombinedExtractor, **kwargs: Any) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


class XQC(CrossQ):
    """CrossQ whose critics learn the distribution of the return by cross-entropy."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": XqcPolicy,
        "MultiInputPolicy": XqcMultiInputPolicy,
    }
    critic: XqcCritic

    def __init__(self, *args: Any, ent_coef: str | float = "auto_0.01", **kwargs: Any) -> None:
        kwargs["ent_coef"] = ent_coef
        super().__init__(*args, **kwargs)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Do `gradient_steps` updates with minibatches of the replay buffer."""
        self.policy.set_training_mode(True)
        optimizers = (self.actor.optimizer, self.critic.optimizer, self.ent_coef_optimizer)
        self._update_learning_rate([optimizer for optimizer in optimizers if optimizer is not None])
        logged: dict[str, list[float]] = defaultdict(list)
        for _ in range(gradient_steps):
            self._n_updates += 1
            data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
            if self.use_sde:
                self.actor.reset_noise()
            coefficient = self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()
            logged["ent_coef"].append(coefficient.item())
            logged["critic_loss"].append(self._learn_critics(data, coefficient))
            if self._n_updates % self.policy_delay == 0:
                self._learn_actor(data, coefficient, logged)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in logged.items():
            self.logger.record(f"train/{name}", np.mean(values))

    def _learn_critics(self, data: Any, coefficient: Tensor) -> float:
        with torch.no_grad():
            self.actor.set_bn_training_mode(False)
            next_actions, log_prob = self.actor.action_log_prob(data.next_observations)
        self.critic.set_bn_training_mode(True)
        observations = _join(data.observations, data.next_observations)
        logits = self.critic.compute_logits(observations, torch.cat([data.actions, next_actions]))
        self.critic.set_bn_training_mode(False)
        now, after = logits.chunk(2, dim=1)
        with torch.no_grad():
            discounts = self.gamma if data.discounts is None else data.discounts
            worse = self.critic.compute_values(after).argmin(0)[:, 0]
            probabilities = after[worse, torch.arange(len(worse), device=worse.device)].softmax(-1)
            returns = self.critic.support - coefficient * log_prob[:, None]
            returns = data.rewards + (1 - data.dones) * discounts * returns
            target = self.critic.project(probabilities, returns)
        loss = -(target * functional.log_softmax(now, -1)).sum(-1).mean(1).sum()
        _step(self.critic.optimizer, loss)
        self.critic.project_weights()
        return loss.item()

    def _learn_actor(self, data: Any, coefficient: Tensor, logged: dict[str, list[float]]) -> None:
        self.actor.set_bn_training_mode(True)
        actions, log_prob = self.actor.action_log_prob(data.observations)
        self.actor.set_bn_training_mode(False)
        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            loss = -(self.log_ent_coef * (log_prob.detach() + float(self.target_entropy))).mean()
            logged["ent_coef_loss"].append(loss.item())
            _step(self.ent_coef_optimizer, loss)
        self.critic.set_bn_training_mode(False)
        values = torch.stack(self.critic(data.observations, actions)).amin(0)
        loss = (coefficient * log_prob[:, None] - values).mean()
        logged["actor_loss"].append(loss.item())
        _step(self.actor.optimizer, loss)


def _join(observations: Any, others: Any) -> Any:
    if isinstance(observations, dict):
        return {key: torch.cat([value, others[key]]) for key, value in observations.items()}
    return torch.cat([observations, others])


def _step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    torch.autograd.backward(loss)
    optimizer.step()
