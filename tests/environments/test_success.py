"""What counts as success in the `info` of an environment."""

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.environments.success import find_success
from rlctl.play.messages import Attach, Build, LoadPolicy, Play, WorkerJob
from rlctl.play.worker import Worker
from rlctl.processes.child_process import anonymous_file


@pytest.mark.parametrize(
    ("info", "success"),
    [
        ({}, None),
        ({"is_success": True}, True),
        ({"is_success": False, "success": 1.0}, False),  # the usual name comes first
        ({"success": 1.0}, 1.0),
        ({"success": np.False_}, np.False_),
        ({"success": np.array([1.0])}, np.array([1.0])),
        ({"is_success": None, "success": 0}, 0),
        ({"success": 0.37}, None),
        ({"success": "yes"}, None),
        ({"success": None}, None),
        ({"success": float("nan")}, None),
        ({"success": np.array([1.0, 0.0])}, None),
        ({"is_success": "yes"}, "yes"),  # which is refused, as it always was
    ],
)
def test_find_success(info, success):
    assert find_success(info) == success


FILE = """
import gymnasium


class Env(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample() * 0, {}

    def step(self, action):
        return action * 0, 0.0, False, True, {"success": 1.0}
"""


def test_episodes_of_workers_have_it(tmp_path):
    (tmp_path / "says.py").write_text(FILE)
    worker = Worker(WorkerJob(anonymous_file(), -1, 0, 1, 1))
    worker.answer(Build(EnvSpec(f"{tmp_path}/says.py:Env")))
    worker.answer(Attach(4))
    worker.answer(LoadPolicy(other="zero"))
    answer = worker.answer(Play(4, {0: 7}))
    assert {episode.success for episode in answer.ended} == {True}
