"""PyBullet environments that would share the world of their process get a process each; all others do not."""

from pathlib import Path

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.play.messages import Play, SharedWorld
from rlctl.play.shared_world import check_memory
from rlctl.storage import untrusted
from tests.play.conftest import ENVS

pytestmark = [pytest.mark.usefixtures("no_child_left"), pytest.mark.pybullet]

BALLS = ENVS.with_name("bullet_envs.py")
BY_NAME = """
    import numpy as np
    from gymnasium import Env, spaces
    from pybullet import *

    class Still(Env):
        observation_space = action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

        def __init__(self):
            self.client = connect(DIRECT)

        def reset(self, *, seed=None, options=None):
            return np.zeros(1, np.float32), {}

        def step(self, action):
            stepSimulation()
            return np.zeros(1, np.float32), 0.0, False, True, {}
"""
OF_THE_MODULE = """
    import numpy as np
    import pybullet
    from gymnasium import Env, spaces

    CLIENT = pybullet.connect(pybullet.DIRECT)

    class Still(Env):
        observation_space = action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

        def reset(self, *, seed=None, options=None):
            return np.zeros(1, np.float32), {}

        def step(self, action):
            pybullet.stepSimulation(physicsClientId=CLIENT)
            return np.zeros(1, np.float32), 0.0, False, True, {}
"""


def play_returns(workers):
    """Play an episode of each environment; return the returns."""
    workers.set_other_policy("random")
    workers.start_playing(Play(20, dict.fromkeys(range(workers.n_envs), 3)))
    return [result.total_reward for result in workers.finish_playing()]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Forgets", "ForgetsToStep"])
def test_each_has_a_process(start, name):
    alone = start(EnvSpec(f"{BALLS}:Ball"), 1)
    workers = start(EnvSpec(f"{BALLS}:{name}"), 3, n_workers=1)
    returns = play_returns(workers)
    assert returns == play_returns(alone) * 3
    assert [envs[0] for envs in workers.playable_envs] == [0, 1, 2]
    assert "without physicsClientId" in workers.shared_world.how
    assert "bullet_envs.py:" in workers.shared_world.how


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("name", ["Ball", "Wrapped"])
def test_a_client_in_every_call_shares_a_process(start, name):
    workers = start(EnvSpec(f"{BALLS}:{name}"), 3, n_workers=1)
    returns = play_returns(workers)
    np.testing.assert_allclose(returns, returns[0])
    assert ([envs[0] for envs in workers.playable_envs], workers.shared_world) == ([0], None)


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(("source", "how"), [(BY_NAME, "by name"), (OF_THE_MODULE, "no PyBullet client of its own")])
def test_calls_that_cannot_be_seen(start, write_module, source, how):
    workers = start(EnvSpec(f"{write_module('stands.py', source)}:Still"), 2, n_workers=1)
    assert play_returns(workers) == [0.0, 0.0]
    assert how in workers.shared_world.how
    assert [envs[0] for envs in workers.playable_envs] == [0, 1]


def test_tasks_and_environments_without_pybullet_share_a_process(start, spec):
    for kind in (EnvSpec("reach"), spec("Walk")):
        workers = start(kind, 2, n_workers=1)
        assert workers.info
        assert ([envs[0] for envs in workers.playable_envs], workers.shared_world) == ([0], None)


def test_too_little_memory_for_so_many_processes():
    world = SharedWorld("walker.py:9 calls loadURDF without physicsClientId", process_bytes=2**55)
    with pytest.raises(TaskError, match=r"walker.py:9 calls loadURDF .*RL808.* not for 64\npass .* or use --n-envs 1$"):
        check_memory("walker.py:Walker", world, 64)
    check_memory("walker.py:Walker", world, 1)


def test_the_group_of_a_container_or_job_limits_the_processes(monkeypatch, tmp_path):
    own = Path("/proc/self/cgroup").read_text().rpartition("0::")[2].strip()
    group = tmp_path / own.strip("/") if own else tmp_path
    group.mkdir(parents=True, exist_ok=True)
    for name, text in {"memory.max": 10 * 2**20, "memory.current": 0, "memory.stat": "file 0\n"}.items():
        (group / name).write_text(str(text))
    monkeypatch.setattr(untrusted, "_CGROUPS", tmp_path)
    # 0.8 * 10 MiB are enough for 4 processes of 2 MiB.
    world = SharedWorld("walker.py:9 calls loadURDF without physicsClientId", process_bytes=2 * 2**20)
    with pytest.raises(TaskError, match="enough for 4, not for 5"):
        check_memory("walker.py:Walker", world, 5)


@pytest.mark.slow
def test_an_error_in_the_trial_is_reported_by_the_first_episode(start, write_module):
    source = OF_THE_MODULE.replace("pybullet.stepSimulation", "1 / 0; pybullet.stepSimulation")
    workers = start(EnvSpec(f"{write_module('stands.py', source)}:Still"), 2, n_workers=1)
    with pytest.raises(TaskError, match=r"ZeroDivisionError(.|\n)*episode seed 3, step 1"):
        play_returns(workers)
