"""The averaged actor: evaluated, kept and exported, while training goes on with the last one."""

import numpy as np
import pytest
import torch

from rlctl.policy.file import PolicyFile
from rlctl.training.averaging import ActorAverage
from tests.training.comparing import rows
from tests.training.test_exact_resume import settings


class _Model:
    def __init__(self):
        self.policy = torch.nn.Module()
        self.policy.actor = torch.nn.Sequential(torch.nn.Linear(2, 1), torch.nn.BatchNorm1d(1))
        self.policy.critic = torch.nn.Linear(2, 1)

    @torch.no_grad()
    def fill(self, value):
        for name, tensor in self.policy.state_dict().items():
            if tensor.is_floating_point() and name.startswith("actor."):
                tensor.fill_(value)


def test_it_is_the_weighted_mean_and_survives_a_checkpoint():
    model = _Model()
    average = ActorAverage(model, 0.9)
    assert average.list_tensors() == {}
    for value, updates in ((1.0, 4), (3.0, 1), (5.0, 2)):
        model.fill(value)
        average.follow(updates)
    expected = (1.0 * 0.9 + 3.0 * 0.1) * 0.9**2 + 5.0 * (1 - 0.9**2)
    tensors = average.list_tensors()
    names = ["0.bias", "0.weight", "1.bias", "1.running_mean", "1.running_var", "1.weight"]
    assert sorted(tensors) == [f"policy/actor.{name}" for name in names]
    for value in tensors.values():
        np.testing.assert_allclose(value, expected, rtol=1e-6)
    other = ActorAverage(_Model(), 0.9)
    other.restore(average.take())
    assert all((other.list_tensors()[name] == value).all() for name, value in tensors.items())


def test_without_decay_there_is_none():
    average = ActorAverage(_Model(), 0.0)
    average.follow(3)
    assert average.take() == {}


@pytest.mark.slow
@pytest.mark.parametrize(("algo", "average"), [("sac", {"actor_average": 0.99}), ("xqc", {})])
def test_the_training_is_the_same_and_the_policy_is_the_average(train, algo, average):
    plain, averaged = (
        train("Line", settings(algo, eval={"every_steps": 1_000}, algo_kwargs=changes)).run
        for changes in ({"actor_average": 0.0}, average)
    )
    drop = ("seconds", "fps", "time")
    first, second = (
        [
            {key: value for key, value in row.items() if not any(word in key for word in drop)}
            for row in rows(run.metrics_file)
        ]
        for run in (plain, averaged)
    )
    assert first == second
    last, mean = (PolicyFile.read(run.last_policy).tensors for run in (plain, averaged))
    changed = {name for name in last if not np.array_equal(last[name], mean[name])}
    assert changed
    assert all(name.startswith("policy/actor.") for name in changed)
