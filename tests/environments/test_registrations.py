"""Ids of a class that is named by its path or module: they may have a time limit and arguments that it lacks."""

import sys

import gymnasium
import pytest

from rlctl.environments.registrations import describe_registrations

FALL = """
    import gymnasium, numpy as np

    class Fall(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-10, 10, (2,))
        action_space = gymnasium.spaces.Box(-1, 1, (1,))

        def __init__(self, speed):
            self.speed = speed

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.state = self.np_random.uniform(-0.1, 0.1, 2).astype(np.float32)
            return self.state.copy(), {}

        def step(self, action):
            angle, velocity = self.state
            velocity += 0.05 * (angle + float(np.clip(action[0], -1, 1))) * self.speed
            self.state = np.array([angle + 0.05 * velocity, velocity], np.float32)
            return self.state.copy(), 1.0, bool(abs(self.state[0]) > 1), False, {}

    class Walk(Fall):
        def __init__(self):
            super().__init__(1.0)
"""
REGISTERS = """
    import gymnasium

    gymnasium.register("Fall-v0", entry_point="walkers.envs:Fall", kwargs={"speed": 0.5})
    gymnasium.register("Walk-v1", entry_point="walkers.envs.fall:Walk", max_episode_steps=200)
    gymnasium.register("Walk-v2", entry_point="walkers.envs.fall:Walk", max_episode_steps=300)
    gymnasium.register("Bare-v0", entry_point="walkers.envs.fall:Walk")
"""


@pytest.fixture
def walkers(tmp_path, write_module, monkeypatch):
    """A package that registers its environments, in the folder `there`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    write_module("there/walkers/__init__.py", REGISTERS)
    write_module("there/walkers/envs/__init__.py", "from .fall import Fall\n")
    write_module("there/walkers/envs/fall.py", FALL)
    registry = dict(gymnasium.registry)
    yield
    for name in set(gymnasium.registry) - set(registry):
        del gymnasium.registry[name]
    for name in [name for name in sys.modules if name.partition(".")[0] == "walkers"]:
        del sys.modules[name]


def test_ids_with_what_they_add(walkers, monkeypatch):
    file = "there/walkers/envs/fall.py"
    walk = "also registered as Walk-v2 with max_episode_steps=300; Walk-v1 with max_episode_steps=200: "
    assert describe_registrations(f"{file}:Walk", "train") == f"{walk}cd there && rlctl train walkers:Walk-v2"
    monkeypatch.chdir("there")
    assert describe_registrations("walkers/envs/fall.py:Walk", "train") == f"{walk}rlctl train walkers:Walk-v2"
    fall = "also registered as Fall-v0 with speed=0.5: rlctl eval walkers:Fall-v0"
    assert describe_registrations("walkers.envs:Fall", "eval") == fall
    assert describe_registrations("walkers:Walk-v1", "eval") == ""


def test_ids_of_gymnasium_itself():
    task = "gymnasium.envs.classic_control:PendulumEnv"
    assert describe_registrations(task, "train").endswith("max_episode_steps=200: rlctl train Pendulum-v1")


@pytest.mark.slow
def test_where_the_missing_limit_and_arguments_matter(rlctl, walkers):
    done = rlctl("check-env", "there/walkers/envs/fall.py:Walk", "--select", "RL506")
    assert (
        "fix: Use its registration: the class is also registered as Walk-v2 with max_episode_steps=300" in done.stdout
    )
    done = rlctl("check-env", "there/walkers/envs/fall.py:Fall")
    assert "The class is also registered as Fall-v0 with speed=0.5: cd there && rlctl check-env walkers" in done.stdout
    done = rlctl("train", "there/walkers/envs/fall.py:Walk", "-n", "100", "--no-check", "--n-envs", "1")
    assert "there/walkers/envs/fall.py:Walk is also registered as Walk-v2 with max_episode_steps=300" in done.stderr
