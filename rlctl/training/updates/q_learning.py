"""Updates of DQN, TD3 and DDPG without autograd; equal to SB3's `train` except for rounding.

V. Mnih et al., Human-level control through deep reinforcement learning, Nature, 2015.
S. Fujimoto et al., Addressing Function Approximation Error in Actor-Critic Methods, 2018,
https://arxiv.org/abs/1802.09477.
"""

import collections
from typing import Any

import numpy as np
import torch
from stable_baselines3 import DDPG, DQN, TD3

from rlctl.training.updates.adam import VectorAdam
from rlctl.training.updates.batches import Batch, sample_batches
from rlctl.training.updates.blocks import OFF_POLICY_BLOCKS, Blocks, count_blocks
from rlctl.training.updates.mlp import bind_networks, is_mlp, list_sizes, uses_tanh
from rlctl.training.updates.perceptrons import clip_norm, count_floats, split_vector
from rlctl.training.updates.q_gradients import ACTOR, CRITICS, DqnGradients, QGradients, QSettings, Td3Gradients


class _QNetworks:
    """Networks and their targets in shared arrays, and the gradients of minibatches."""

    def __init__(self, kind: type[QGradients], settings: QSettings) -> None:
        self._count = count_blocks(settings.rows, settings.count_weights(), most=OFF_POLICY_BLOCKS)
        self._blocks = Blocks(kind, settings, self._count)
        self.arrays, self.close, self._rows = self._blocks.arrays, self._blocks.close, settings.rows
        self.arrays["count"][...] = self._count
        self._shapes, self._split = settings.list_shapes(), len(settings.list_critic_shapes())
        of_critics = count_floats(settings.list_critic_shapes())
        self._parts = {CRITICS: slice(0, of_critics), ACTOR: slice(of_critics, len(self.arrays["gradient"]))}

    def bind(self, name: str, critics: Any, actors: Any = ()) -> None:
        """Make "parameters" or "targets" the memory of these networks."""
        values, gradients = (split_vector(self.arrays[key], self._shapes) for key in (name, "gradient"))
        gradients = gradients if name == "parameters" else []
        bind_networks(critics, values[: self._split], gradients[: self._split])
        bind_networks(actors, values[self._split :], gradients[self._split :])

    def read(self, batch: Batch) -> None:
        """Write a minibatch into the shared arrays."""
        for name in ("features", "next_features", "actions", "rewards", "discounts"):
            self.arrays[name][:] = getattr(batch, name)

    def differentiate(self, phase: int) -> tuple[Any, float]:
        """Set the gradients of the critics or of the actor; return them as a vector, and the loss."""
        self._blocks.run(phase, self._count)
        gradient = self._blocks.add_gradients(self._count, self._parts[phase])
        return gradient, float(self.arrays["losses"][: self._count, phase].sum()) / self._rows

    def make_adam(self, phase: int, optimizer: torch.optim.Optimizer) -> VectorAdam:
        """Return what updates the critics or the actor."""
        return VectorAdam(optimizer, *(self.arrays[name][self._parts[phase]] for name in ("parameters", "gradient")))

    def follow(self, tau: float) -> None:
        """Move the targets towards the networks."""
        targets, parameters = (torch.from_numpy(self.arrays[name]) for name in ("targets", "parameters"))
        targets.lerp_(parameters, tau)


class DqnUpdate:
    """Updates a DQN model whose network is a multi-layer perceptron on the CPU."""

    def __init__(self, model: Any) -> None:
        self._model = model
        network = list(model.q_net.q_net)
        sizes = list_sizes(network)
        settings = QSettings(
            rows=model.batch_size,
            features=sizes[0],
            actions=1,
            critic=sizes,
            critics=1,
            critic_uses_tanh=uses_tanh(network),
        )
        self._networks = _QNetworks(DqnGradients, settings)
        self.close = self._networks.close
        self._networks.bind("parameters", [network])
        self._networks.bind("targets", [model.q_net_target.q_net])
        self._adam = self._networks.make_adam(CRITICS, model.policy.optimizer)

    @classmethod
    def supports(cls, model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        return type(model) is DQN and is_mlp(model.q_net.q_net)

    @torch.no_grad()
    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do `gradient_steps` updates with minibatches of the replay buffer; log what SB3 logs."""
        model = self._model
        model._update_learning_rate(model.policy.optimizer)
        batches = sample_batches(model, model.q_net, gradient_steps, batch_size)
        losses = [self._learn_minibatch(batch) for batch in batches]
        model._n_updates += gradient_steps
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
        model.logger.record("train/loss", np.mean(losses))

    def _learn_minibatch(self, batch: Batch) -> float:
        """Learn from a minibatch; return the loss before."""
        self._networks.read(batch)
        gradient, loss = self._networks.differentiate(CRITICS)
        clip_norm(gradient, self._model.max_grad_norm)
        self._adam.step()
        return loss


class Td3Update:
    """Updates a TD3 or DDPG model whose networks are multi-layer perceptrons on the CPU."""

    def __init__(self, model: Any) -> None:
        self._model = model
        # The last module of an actor is the tanh that squashes its actions.
        actor, critic = list(model.actor.mu[:-1]), list(model.critic.q_networks[0])
        sizes = list_sizes(actor)
        settings = QSettings(
            rows=model.batch_size,
            features=sizes[0],
            actions=sizes[-1],
            critic=list_sizes(critic),
            critics=len(model.critic.q_networks),
            critic_uses_tanh=uses_tanh(critic),
            actor=sizes,
            actor_uses_tanh=uses_tanh(actor),
        )
        self._networks = _QNetworks(Td3Gradients, settings)
        self.close = self._networks.close
        self._networks.bind("parameters", model.critic.q_networks, [actor])
        self._networks.bind("targets", model.critic_target.q_networks, [model.actor_target.mu[:-1]])
        optimizers = {CRITICS: model.critic.optimizer, ACTOR: model.actor.optimizer}
        self._adam = {phase: self._networks.make_adam(phase, optimizer) for phase, optimizer in optimizers.items()}

    @classmethod
    def supports(cls, model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        if type(model) not in (TD3, DDPG):
            return False
        networks = (model.actor.mu[:-1], *model.critic.q_networks)
        return isinstance(model.actor.mu[-1], torch.nn.Tanh) and all(is_mlp(network) for network in networks)

    @torch.no_grad()
    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do `gradient_steps` updates with minibatches of the replay buffer; log what SB3 logs."""
        model, networks = self._model, self._networks
        model._update_learning_rate([model.actor.optimizer, model.critic.optimizer])
        logged: dict[str, list[float]] = collections.defaultdict(list)
        for batch in sample_batches(model, model.actor, gradient_steps, batch_size):
            model._n_updates += 1
            networks.read(batch)
            noise = torch.from_numpy(networks.arrays["noise"])
            noise.normal_(0, model.target_policy_noise)  # torch's generator, as in SB3
            noise.clamp_(-model.target_noise_clip, model.target_noise_clip)
            logged["critic_loss"].append(networks.differentiate(CRITICS)[1])
            self._adam[CRITICS].step()
            if model._n_updates % model.policy_delay == 0:
                logged["actor_loss"].append(networks.differentiate(ACTOR)[1])
                self._adam[ACTOR].step()
                networks.follow(model.tau)
        for name, values in logged.items():
            model.logger.record(f"train/{name}", np.mean(values))
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
