"""Learning claims: the shipped recipe, three seeds, 100 episodes each."""

import pytest

from rlctl.eval.evaluate import EvalRequest, Gates, run_evaluation
from rlctl.train.request import TrainRequest, run_training


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_reach_is_learnt(tmp_path, seed):
    run = run_training(TrainRequest("reach", settings={"seed": seed}, root=tmp_path)).run
    wide = run_evaluation(EvalRequest(str(run.path)), Gates())
    strict = run_evaluation(EvalRequest(str(run.path), task_parameters={"tolerance": 0.02}), Gates())
    assert wide.success_rate >= 0.98
    assert strict.success_rate >= 0.90
