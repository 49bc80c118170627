"""A snapshot holds the random generators that a training draws from."""

import types

import pytest
import torch
from stable_baselines3 import SAC

from rlctl.training import snapshot


@pytest.fixture
def gpu(monkeypatch):
    """A GPU's module of PyTorch with a generator, for machines without one."""
    states = {torch.device("cuda:1"): torch.arange(16, dtype=torch.uint8)}
    module = types.SimpleNamespace(
        get_rng_state=states.__getitem__, set_rng_state=lambda state, device: states.update({device: state})
    )
    monkeypatch.setattr(torch, "get_device_module", lambda device: module)
    return states


def test_the_generator_of_a_gpu(gpu):
    model = SAC("MlpPolicy", "Pendulum-v1", device="cpu", policy_kwargs={"net_arch": [4]}, buffer_size=4)
    on_cpu = snapshot.take(model)
    device = torch.device("cuda:1")
    model.device = device
    tensors, plain = snapshot.take(model)
    gpu[device] = torch.zeros(16, dtype=torch.uint8)
    snapshot.restore(model, *on_cpu)  # of a training on the CPU: the generator stays
    assert not gpu[device].any()
    snapshot.restore(model, tensors, plain)
    assert gpu[device].tolist() == list(range(16))
