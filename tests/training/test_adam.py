"""Short steps of Adam: torch's own, but for rounding."""

import copy

import torch
from stable_baselines3.common.utils import set_random_seed

from rlctl.training.updates import adam


def train_parts_of_a_vector(make_step):
    """Do six steps of Adam, the fifth with torch; after three replace the state, as loading a checkpoint does."""
    set_random_seed(0)
    vector, gradient = torch.randn(64 * 9 + 64), torch.zeros(64 * 9 + 64)
    values = []
    for part, shape in ((slice(0, 64 * 9), (64, 9)), (slice(64 * 9, 64 * 10), (64,))):
        values.append(torch.nn.Parameter(vector[part].view(shape)))
        values[-1].grad = gradient[part].view(shape)
    optimizer = torch.optim.Adam(values, 1e-2, (0.5, 0.9), 1e-5, weight_decay=0.1, fused=True)
    step = make_step(optimizer, vector.numpy(), gradient.numpy())
    for number in range(6):
        if number == 3:
            optimizer.load_state_dict(copy.deepcopy(optimizer.state_dict()))
        gradient.normal_()
        (optimizer.step if number == 4 else step)()
    state = optimizer.state_dict()["state"]
    return [*values, *(state[index][name] for index in range(2) for name in ("exp_avg", "exp_avg_sq", "step"))]


def test_adam_of_a_vector_is_torchs():
    with torch.no_grad():
        theirs = train_parts_of_a_vector(lambda optimizer, *_: optimizer.step)
        ours = train_parts_of_a_vector(lambda *arguments: adam.VectorAdam(*arguments).step)
    assert ours[-1] == 6
    assert all(torch.allclose(one, other, rtol=1e-6, atol=1e-7) for one, other in zip(ours, theirs, strict=True))


def test_the_short_step_of_adam_is_torchs():
    def train(step):
        set_random_seed(0)
        values = [torch.nn.Parameter(torch.randn(shape)) for shape in ((64, 9), (64,), ())]
        unused = torch.nn.Parameter(torch.zeros(2))
        optimizer = torch.optim.Adam([*values, unused], 1e-2, (0.5, 0.9), 1e-5, weight_decay=0.1, fused=True)
        for _ in range(5):
            for value in values:
                value.grad = torch.randn(value.shape)
            step(optimizer)
        return [*values, *(state for value in values for state in optimizer.state[value].values())]

    with torch.no_grad():
        pairs = list(zip(train(adam.step), train(torch.optim.Adam.step), strict=True))
    assert all(torch.equal(ours, theirs) for ours, theirs in pairs)
