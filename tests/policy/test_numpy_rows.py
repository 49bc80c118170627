"""Many rows at once: the bits of each one alone, whatever the other rows are."""

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.environments.dict_spaces import stack
from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.environments.spec import EnvSpec
from rlctl.errors import DivergedError
from rlctl.policy.actor import Exploration, Rows, as_rows
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.numpy_actor import NumpyActor
from tests.policy.test_numpy_actor import CASES, policy  # noqa: F401

EXPLORATIONS = {
    "mean": Exploration(),
    "samples": Exploration(stochastic=True, sde_every=4, action_noise=0.2, epsilon=0.3),
    "uniform": Exploration(warmup=True),
}
COUNT = 33


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


def check_rows(file, count, observations, exploration):
    """Compare the actions of all rows, of some in another order, and of each alone, for two segments of 3 steps."""
    together, some, alone = NumpyActor(file, count), NumpyActor(file, count), [NumpyActor(file) for _ in range(count)]
    actors = [together, some, *alone]
    rng = np.random.default_rng(7)
    rows = Rows(np.arange(count), 100 + np.arange(count), rng.integers(0, 62, count))
    parts = np.split(rng.permutation(count), [1, 3, 6])
    for actor in actors:
        actor.explore(exploration)
    for step, observed in enumerate(observations):
        if step % 3 == 0:
            for actor in actors:
                actor.prepare()
        stored, actions = together.act(observed, rows)
        assert len(stored) == len(actions) == count
        for part in parts:
            few, _ = some.act(stack([take(observed, k) for k in part]), rows.select(part))
            np.testing.assert_array_equal(few, stored[part])
        for k, actor in enumerate(alone):
            one, action = actor.act(as_rows(take(observed, k)), Rows.one(100 + k, int(rows.step[k])))
            np.testing.assert_array_equal(one[0], stored[k])
            np.testing.assert_array_equal(action[0], actions[k])
        rows.step += 1


def take(observations, k):
    return {key: part[k] for key, part in observations.items()} if isinstance(observations, dict) else observations[k]


@pytest.mark.slow_except("recurrent_ppo-samples", "ppo, dict-samples", "ppo, gSDE-samples")
@pytest.mark.parametrize("exploration", EXPLORATIONS)
@pytest.mark.parametrize("case", CASES)
def test_the_bits_of_one_alone(policy, case, exploration):  # noqa: F811
    file, _ = policy(case)
    space = file.info.env.spaces()[0]
    space.seed(0)
    count = 7 if "image" in case or "dict" in case else COUNT
    observations = [stack([space.sample() for _ in range(count)]) for _ in range(6)]
    check_rows(file, count, observations, EXPLORATIONS[exploration])


@pytest.mark.slow_except("(64, 64)-mean", "(33,)-samples")
@pytest.mark.parametrize("exploration", ["mean", "samples"])
def test_the_bits_of_one_alone_in_wide_networks(wide, exploration):
    rng = np.random.default_rng(1)
    observations = [rng.normal(0, 2, (70, 45)).astype(np.float32) for _ in range(2)]
    check_rows(wide, 70, observations, EXPLORATIONS[exploration])


def test_new_weights_count_from_the_next_segment_on():
    file = make_wide((16,))
    actor, rows = NumpyActor(file, 2), Rows.first(2)
    observations = np.ones((2, 45), np.float32)
    actor.explore(EXPLORATIONS["samples"])
    first, _ = actor.act(observations, rows)
    file.tensors["policy/action_net.bias"] += 1.0
    file.tensors["policy/log_std"][:] = -20.0
    actor.prepare()
    actor.explore(EXPLORATIONS["mean"])
    second, _ = actor.act(observations, rows)
    actor.explore(EXPLORATIONS["samples"])
    third, _ = actor.act(observations, rows)
    assert (second != first).all()
    np.testing.assert_allclose(second, third, atol=1e-6)


def test_a_recurrent_state_is_forgotten_where_an_episode_begins(policy):  # noqa: F811
    file, _ = policy("recurrent_ppo")
    actor, rows = NumpyActor(file, 3), Rows.first(3)
    observations = np.ones((3, 6), np.float32)
    first, _ = actor.act(observations, rows)
    actor.begin(rows.select([1]))
    second, _ = actor.act(observations, rows)
    np.testing.assert_array_equal(second[1], first[1])
    assert (second[[0, 2]] != first[[0, 2]]).any(axis=1).all()


def test_an_action_that_is_not_finite_is_that_of_its_environment():
    actor = NumpyActor(make_wide((16,)), 5)
    observations = np.zeros((2, 45), np.float32)
    observations[1] = np.inf
    rows = Rows(np.array([3, 4]), np.array([1, 2]), np.array([0, 0]))
    with (
        pytest.raises(DivergedError, match="the policy's action is not finite") as caught,
        np.errstate(invalid="ignore"),
    ):
        actor.act(observations, rows)
    assert caught.value.world == 4
