"""One forward pass for many environments: the actions of one at a time, whatever the other rows are."""

import numpy as np
import pytest
import torch
from gymnasium import spaces

from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.environments.spec import EnvSpec
from rlctl.errors import DivergedError
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.numpy_policy import PolicyPlayer
from rlctl.policy.players.player import Exploration
from rlctl.policy.rows import RowsPolicy
from tests.policy.test_numpy_policy import BOX, CASES, FLAT, policy  # noqa: F401

SUPPORTED = {"ppo", "ppo, elu", "ppo, silu", "ppo, no layers", "ppo, gSDE"}
EXPLORATIONS = [Exploration(), Exploration(stochastic=True)]
SDE = Exploration(stochastic=True, sde_every=4)


def make_wide(sizes, observed=45, seed=0, *, use_sde=False) -> PolicyFile:
    """Return a policy of a multi-layer perceptron for 12 actions, with normalised observations."""
    rng = np.random.default_rng(seed)
    info = EnvInfo(
        observation_space=space_to_json(spaces.Box(-np.inf, np.inf, (observed,), np.float32)),
        action_space=space_to_json(spaces.Box(-1.0, 1.0, (3, 4), np.float32)),
    )
    tensors, last = {}, observed
    for index, size in enumerate(sizes):
        tensors[f"policy/mlp_extractor.policy_net.{2 * index}.weight"] = rng.normal(0, last**-0.5, (size, last))
        tensors[f"policy/mlp_extractor.policy_net.{2 * index}.bias"] = rng.normal(0, 0.1, size)
        last = size
    tensors["policy/action_net.weight"] = rng.normal(0, last**-0.5, (12, last))
    tensors["policy/action_net.bias"] = rng.normal(0, 0.1, 12)
    tensors["policy/log_std"] = rng.normal(-1, 0.1, (last, 12) if use_sde else 12)
    tensors = {name: value.astype(np.float32) for name, value in tensors.items()}
    tensors |= {"normalize//mean": rng.normal(0, 1, observed), "normalize//var": rng.uniform(0.5, 2, observed)}
    packed = PolicyInfo(
        algo="ppo",
        policy="MlpPolicy",
        env=info,
        spec=EnvSpec("test"),
        policy_kwargs={"net_arch": list(sizes), "use_sde": use_sde},
        normalized_keys=[""],
    )
    return PolicyFile(packed, tensors)


@pytest.fixture(params=[(64, 64), (128, 128), (33,), (256, 128, 64)], ids=str)
def wide(request):
    return make_wide(request.param)


def act(rows, observations, seeds, steps, places, exploration):
    return rows.act(
        observations,
        np.asarray(seeds, np.int64),
        np.asarray(steps, np.int64),
        np.asarray(places, np.int64),
        exploration,
    )


@pytest.mark.parametrize("exploration", EXPLORATIONS, ids=["mean", "samples"])
def test_the_actions_of_one_at_a_time(wide, exploration):
    count, rng = 70, np.random.default_rng(1)
    rows, player = RowsPolicy(wide, count), PolicyPlayer(wide)
    rows.begin_segment()
    player.explore(exploration)
    for first_step in (0, 62):  # the block of random numbers changes at step 64
        observations = rng.normal(0, 2, (count, 45)).astype(np.float32)
        seeds, steps = 100 + np.arange(count), first_step + np.arange(count) % 5
        stored, actions = act(rows, observations, seeds, steps, range(count), exploration)
        assert stored.shape == (count, 12)
        assert actions.shape == (count, 3, 4)
        for k in range(count):
            player.begin_segment(int(seeds[k]), int(steps[k]))
            one, action = player.act(observations[k], int(seeds[k]), int(steps[k]))
            np.testing.assert_allclose(stored[k], one, atol=1e-5)
            np.testing.assert_allclose(actions[k], action, atol=1e-5)


def test_the_same_noise(wide):
    """Sampled minus mean action, bit for bit up to the rounding of a sum near 1."""
    count = 9
    rows, player = RowsPolicy(wide, count), PolicyPlayer(wide)
    rows.begin_segment()
    observations, seeds, steps = np.zeros((count, 45), np.float32), np.arange(count), 60 + np.arange(count)
    mean, _ = act(rows, observations, seeds, steps, range(count), EXPLORATIONS[0])
    samples, _ = act(rows, observations, seeds, steps, range(count), EXPLORATIONS[1])
    for k in range(count):
        noise = player._network.compute_std(np.zeros(1)) * player._noise.draw(k, 60 + k)[0][0]
        np.testing.assert_allclose(samples[k] - mean[k], noise, atol=5e-7)


@pytest.mark.parametrize("exploration", EXPLORATIONS, ids=["mean", "samples"])
def test_an_action_does_not_depend_on_the_other_rows(wide, exploration):
    count, rng = 129, np.random.default_rng(2)
    rows, other = RowsPolicy(wide, count), RowsPolicy(wide, 7)
    rows.begin_segment()
    other.begin_segment()
    observations = rng.normal(0, 2, (count, 45)).astype(np.float32)
    seeds, steps = rng.integers(0, 1000, count), rng.integers(0, 200, count)
    every, _ = act(rows, observations, seeds, steps, range(count), exploration)
    for size in (1, 2, 3, 5, 64, 100):
        some = rng.permutation(count)[:size]
        few, _ = act(rows, observations[some], seeds[some], steps[some], some, exploration)
        np.testing.assert_array_equal(few, every[some])
    places = np.array([6, 2])
    few, _ = act(other, observations[[128, 5]], seeds[[128, 5]], steps[[128, 5]], places, exploration)
    np.testing.assert_array_equal(few, every[[128, 5]])


def test_gsde_explores_as_one_at_a_time():
    """Its matrices change at the start of a segment and every 4 steps; episodes are at different steps."""
    count, rng = 11, np.random.default_rng(3)
    file = make_wide((32, 16), use_sde=True)
    rows, players = RowsPolicy(file, count), [PolicyPlayer(file) for _ in range(count)]
    seeds = 50 + np.arange(count)
    for first_step in (0, 6):  # of two segments of 6 steps
        rows.begin_segment()
        steps = first_step + np.arange(count) % 3
        for k, player in enumerate(players):
            player.explore(SDE)
            player.begin_segment(int(seeds[k]), int(steps[k]))
        for _ in range(6):
            observations = rng.normal(0, 2, (count, 45)).astype(np.float32)
            stored, _ = act(rows, observations, seeds, steps, range(count), SDE)
            for k, player in enumerate(players):
                expected = player.act(observations[k], int(seeds[k]), int(steps[k]))[0]
                np.testing.assert_allclose(stored[k], expected, atol=1e-5)
            steps = steps + 1


def test_gsde_does_not_depend_on_the_other_rows():
    count, rng = 40, np.random.default_rng(4)
    file = make_wide((64, 64), use_sde=True)
    rows, other = RowsPolicy(file, count), RowsPolicy(file, count)
    rows.begin_segment()
    other.begin_segment()
    observations = rng.normal(0, 2, (count, 45)).astype(np.float32)
    seeds, steps = np.arange(count), rng.integers(0, 200, count)
    every, _ = act(rows, observations, seeds, steps, range(count), SDE)
    some = rng.permutation(count)[:7]
    few, _ = act(other, observations[some], seeds[some], steps[some], some, SDE)
    np.testing.assert_array_equal(few, every[some])


def test_new_weights_count_from_the_next_segment_on():
    file = make_wide((16,))
    rows = RowsPolicy(file, 2)
    rows.begin_segment()
    observations = np.ones((2, 45), np.float32)
    first, _ = act(rows, observations, [1, 2], [0, 0], [0, 1], EXPLORATIONS[1])
    file.tensors["policy/action_net.bias"] += 1.0
    file.tensors["policy/log_std"][:] = -20.0
    rows.begin_segment()
    second, _ = act(rows, observations, [1, 2], [0, 0], [0, 1], EXPLORATIONS[0])
    third, _ = act(rows, observations, [1, 2], [0, 0], [0, 1], EXPLORATIONS[1])
    assert (second != first).all()
    np.testing.assert_allclose(second, third, atol=1e-6)


def test_an_action_that_is_not_finite_is_that_of_its_environment():
    rows = RowsPolicy(make_wide((16,)), 5)
    rows.begin_segment()
    observations = np.zeros((2, 45), np.float32)
    observations[1] = np.inf
    with (
        pytest.raises(DivergedError, match="the policy's action is not finite") as caught,
        np.errstate(invalid="ignore"),
    ):
        act(rows, observations, [1, 2], [0, 0], [3, 4], EXPLORATIONS[0])
    assert caught.value.world == 4


@pytest.mark.parametrize("case", [case for case, (_, observed, *_) in CASES.items() if observed is FLAT])
def test_which_policies_it_plays(policy, case):  # noqa: F811
    torch.manual_seed(0)
    file, _ = policy(case)
    assert RowsPolicy.supports(file) is (case in SUPPORTED)
    if case in SUPPORTED:
        assert file.info.env.spaces()[1] == BOX
