"""Networks as a user writes them, good and bad."""

import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor


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


def function():
    return None
