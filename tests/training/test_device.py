"""Which device a network learns on: as measured, and said only where there is a choice."""

import pytest
import torch

from rlctl.errors import UsageError
from rlctl.play.workers import Workers
from rlctl.recipe import sources
from rlctl.recipe.recipe import validate
from rlctl.training.algorithms import build_on_device
from rlctl.training.device import MOST_WEIGHTS, describe_device, find_fastest
from rlctl.training.rollouts import WorkerVecEnv
from tests.training.conftest import ENVS

SMALL = [(64, 3), (64,), (64, 64), (64,), (1, 64)]
WIDE = [(1024, 17), (1024,), (1024, 1024), (1024,)]
CONVOLUTIONS = [(32, 4, 8, 8), (32,), (64, 32, 4, 4)]
LSTM = [(1024, 3), (1024, 256)]  # of recurrent_ppo with its usual 256 units


@pytest.mark.parametrize(
    ("shapes", "expected"),
    [
        (SMALL, ("cpu", "the network is small")),
        (LSTM, ("cpu", "the network is small")),
        (WIDE, ("cuda", "a layer has 1,048,576 weights")),
        (CONVOLUTIONS, ("cuda", "the network has convolutions")),
        ([(512, 512)], ("cpu", "the network is small")),
        ([(513, 512)], ("cuda", "a layer has 262,656 weights")),
        ([], ("cpu", "the network is small")),
    ],
)
def test_large_networks_learn_on_a_gpu(shapes, expected):
    assert find_fastest(shapes, cuda_available=True) == expected
    assert find_fastest(shapes, cuda_available=False) == ("cpu", "torch sees no GPU")


@pytest.mark.parametrize(
    ("requested", "shapes", "expected"),
    [
        ("auto", SMALL, "device: cpu, because the network is small"),
        ("auto", CONVOLUTIONS, "device: cuda, because the network has convolutions"),
        ("cpu", SMALL, None),
        (
            *("cpu", CONVOLUTIONS),
            "device: cpu; --device cuda is probably faster, because the network has convolutions (docs/gpu.md)",
        ),
        (
            *("cuda:1", SMALL),
            "device: cuda:1; --device cpu is probably faster, because the network is small (docs/gpu.md)",
        ),
        ("cuda:1", WIDE, None),
        ("mps", SMALL, None),
    ],
)
def test_the_choice_is_said_where_there_is_one(requested, shapes, expected):
    fastest, reason = find_fastest(shapes, cuda_available=True)
    assert describe_device(requested, fastest, reason, cuda_available=True) == expected
    fastest, reason = find_fastest(shapes, cuda_available=False)
    assert describe_device(requested, fastest, reason, cuda_available=False) is None


@pytest.fixture
def build():
    """Build the model of SAC with a network on `Line`, as if a GPU was there or not."""

    def model(net_arch, requested, *, cuda_available):
        recipe = sources.fill_defaults(
            validate({"algo": "sac", "n_envs": 1, "policy_kwargs": {"net_arch": net_arch}}, "test")
        )
        with Workers(recipe.env_specs(f"{ENVS}:Line")[0], 1) as workers:
            return build_on_device(recipe, WorkerVecEnv(workers, 0), requested, cuda_available=cuda_available)

    return model


def test_auto_takes_the_cpu_for_a_small_network(build):
    model, line = build([256, 256], "auto", cuda_available=True)
    assert model.device.type == "cpu"
    assert line == "device: cpu, because the network is small"


def test_auto_without_a_gpu_is_the_cpu(build):
    model, line = build([600, 600], "auto", cuda_available=False)
    assert model.device.type == "cpu"
    assert line is None


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU")
def test_auto_takes_the_gpu_for_a_wide_network(build):
    assert MOST_WEIGHTS < 600 * 600
    with pytest.raises(UsageError, match="--device cuda: torch sees 0 CUDA devices"):  # it was told of one
        build([600, 600], "auto", cuda_available=True)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_auto_learns_on_the_gpu(build):
    assert build([600, 600], "auto", cuda_available=True)[0].device.type == "cuda"
