"""What a training prints at its end."""

import dataclasses

import pytest

from rlctl.launching.train import list_next_commands
from rlctl.policy.file import Score


@pytest.mark.slow
def test_a_policy_that_never_succeeded_is_not_to_be_exported_next(train):
    result = train("Line", {"total_timesteps": 64, "n_envs": 2, "algo_kwargs": {"n_steps": 32, "batch_size": 32}})
    for success, is_shown in ((None, True), (0.5, True), (0.0, False)):
        best = result.best.model_copy(update={"evaluation": Score(success=success, mean_return=1.0)})
        commands = list_next_commands(dataclasses.replace(result, best=best))
        assert any(command.startswith("rlctl export") for command in commands) == is_shown
        assert any(command.endswith("--audit") for command in commands) != is_shown
