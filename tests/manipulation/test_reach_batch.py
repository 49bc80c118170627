"""`reach-batch` is `reach` for many worlds: the same episodes."""

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec

pytest.importorskip("mujoco")


def test_it_is_reach():
    """Same start and goal for a seed; batches integrate otherwise, so that joints differ by some milliradians later."""
    one, batch = EnvSpec("reach", sim=MUJOCO).make(), EnvSpec("reach-batch").make()
    np.testing.assert_allclose(batch.reset(seed=5)[0], one.reset(seed=5)[0], atol=1e-6)
    rng = np.random.default_rng(0)
    for _ in range(40):
        action = rng.uniform(-1, 1, 7).astype(np.float32)
        (observed, reward, *_, info), (expected, wanted, *_, expected_info) = batch.step(action), one.step(action)
        np.testing.assert_allclose(observed[:7], expected[:7], atol=0.02)  # [rad]
        assert reward == pytest.approx(wanted, abs=0.05)
        assert info["reward_terms"].keys() == expected_info["reward_terms"].keys()
