"""Networks as a user writes them, good and bad."""

import torch
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.dqn.policies import DQNPolicy
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy


class Gated(BaseFeaturesExtractor):
    """Has two branches, and takes every kind of observation."""

    def __init__(self, observation_space, features_dim=8):
        super().__init__(observation_space, features_dim)
        sizes = [part.shape for part in getattr(observation_space, "spaces", {"": observation_space}).values()]
        size = sum(int(torch.Size(shape or (5,)).numel()) for shape in sizes)
        self.value, self.gate = torch.nn.Linear(size, features_dim), torch.nn.Linear(size, features_dim)
        self.norm = torch.nn.BatchNorm1d(features_dim)

    def forward(self, observations):
        parts = observations.values() if isinstance(observations, dict) else [observations]
        flat = torch.cat([part.flatten(1) for part in parts], dim=1)
        return self.norm(torch.tanh(self.value(flat)) * torch.sigmoid(self.gate(flat)))


class Wave(torch.nn.Module):
    def forward(self, x):
        return torch.sin(x)


class WrongShape(Gated):
    def forward(self, observations):
        return super().forward(observations)[:, :3]


class Raises(Gated):
    def forward(self, observations):
        raise KeyError("gate")


class Residual(torch.nn.Module):
    def __init__(self, size):
        super().__init__()
        self.inner, self.norm = torch.nn.Linear(size, size), torch.nn.LayerNorm(size)

    def forward(self, x):
        return x + torch.tanh(self.norm(self.inner(x)))


class TwoBodies(torch.nn.Module):
    """As in SB3's documentation of custom policies."""

    latent_dim_pi = latent_dim_vf = 6

    def __init__(self, size):
        super().__init__()
        self.of_actor = torch.nn.Sequential(torch.nn.Linear(size, 6), Residual(6))
        self.of_critic = torch.nn.Linear(size, 6)

    def forward(self, features):
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features):
        return self.of_actor(features)

    def forward_critic(self, features):
        return torch.relu(self.of_critic(features))


class OwnActorCritic(ActorCriticPolicy):
    def __init__(self, observation_space, action_space, lr_schedule, **kwargs):
        super().__init__(observation_space, action_space, lr_schedule, ortho_init=False, **kwargs)

    def _build_mlp_extractor(self):
        self.mlp_extractor = TwoBodies(self.features_dim)


class OwnSac(SACPolicy):
    def make_actor(self, *args, **kwargs):
        actor = super().make_actor(*args, **kwargs)
        actor.latent_pi = torch.nn.Sequential(torch.nn.Flatten(), actor.latent_pi, Residual(8))
        return actor


class OwnTd3(TD3Policy):
    def make_actor(self, *args, **kwargs):
        actor = super().make_actor(*args, **kwargs)
        actor.mu = torch.nn.Sequential(*actor.mu[:-2], Residual(8), *actor.mu[-2:])
        return actor


class OwnDqn(DQNPolicy):
    def make_q_net(self):
        net = super().make_q_net()
        net.q_net = torch.nn.Sequential(Residual(net.features_dim), net.q_net)
        return net


class OwnRecurrent(RecurrentActorCriticPolicy):
    pass


class OwnDistribution(OwnActorCritic):
    def _get_action_dist_from_latent(self, latent):
        return super()._get_action_dist_from_latent(-latent)


class OwnChoice(OwnActorCritic):
    def _predict(self, observation, deterministic=False):
        return 0.5 * super()._predict(observation, deterministic)


class NoHead(OwnActorCritic):
    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.action_net = torch.nn.Sequential(self.action_net, torch.nn.Tanh())


class PolicyRaises(OwnActorCritic):
    def _build_mlp_extractor(self):
        raise KeyError("bodies")


def function():
    return None
