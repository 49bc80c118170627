"""What a training prints at its end."""

import copy
import dataclasses

from rlctl.training.summary import show


def test_a_policy_that_never_succeeded_is_not_to_be_exported_next(train, capfd):
    result = train("Line", {"total_timesteps": 64, "n_envs": 2, "algo_kwargs": {"n_steps": 32, "batch_size": 32}})
    for success, is_shown in ((None, True), (0.5, True), (0.0, False)):
        progress = copy.copy(result.progress)
        progress.best_success = success
        capfd.readouterr()
        show(dataclasses.replace(result, progress=progress), None)
        assert ("rlctl export" in capfd.readouterr().out) == is_shown
