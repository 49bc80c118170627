"""Learning claims: the shipped recipe, three seeds, 100 episodes each."""

import pytest

from rlctl.environments.spec import EnvChanges
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.launching.train import run_training
from rlctl.runs.train_request import TrainRequest
from tests.training.conftest import ENVS


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_reach_is_learnt(tmp_path, seed):
    run = run_training(TrainRequest("reach", settings={"seed": seed}, root=tmp_path, check=False)).run
    wide = run_evaluation(EvalRequest(str(run.path)))
    strict = run_evaluation(EvalRequest(str(run.path), changes=EnvChanges({"tolerance": 0.02})))
    assert wide.success_rate >= 0.98
    assert strict.success_rate >= 0.90


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_sparse_reward_is_learnt_in_hindsight_only(tmp_path, seed):
    """A goal of radius 0.05 in a square of side 2, -1 away from it: chance finds it too rarely in 4,000 steps."""
    rates = {}
    for her in (True, False):
        settings = {
            "algo": "sac",
            "her": {} if her else None,
            "task": {"tolerance": 0.05},
            "seed": seed,
            "n_envs": 4,
            "total_timesteps": 4000,
            "algo_kwargs": {"gamma": 0.95, "learning_rate": 1e-3, "batch_size": 128},
            "policy_kwargs": {"net_arch": [64, 64]},
            "eval": {"episodes": 20, "every_steps": 4000},
        }
        run = run_training(TrainRequest(f"{ENVS}:Plane", settings=settings, root=tmp_path, check=False)).run
        rates[her] = run_evaluation(EvalRequest(str(run.path), episodes=100)).success_rate
    assert rates[True] >= 0.95
    assert rates[False] <= 0.2
