"""Policies of a few numbers, made without torch."""

import numpy as np

from rlctl.environments.spec import EnvSpec
from rlctl.policy.file import PolicyFile, PolicyInfo


def linear(info, weight, log_std=None, bias=0.0):
    """Return a policy whose mean action, or logits, is `weight @ observation + bias`."""
    weight = np.asarray(weight, np.float32)
    tensors = {"policy/action_net.weight": weight, "policy/action_net.bias": np.full(len(weight), bias, np.float32)}
    if log_std is not None:
        tensors["policy/log_std"] = np.full(len(weight), log_std, np.float32)
    return PolicyFile(PolicyInfo(algo="ppo", policy="MlpPolicy", env=info, spec=EnvSpec("test")), tensors)
