import json
import subprocess
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.play.episode import save_episode
from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.recorder import Rollout, play_episode
from rlctl.task.pybullet.library import pybullet
from rlctl_manipulation.reach import JOINT_STEP

ENVS = Path(__file__).with_name("envs.py")
HAND = 6  # link index


@pytest.fixture(autouse=True)
def strict(monkeypatch):
    """Rerun raises for what it would otherwise leave out of a recording."""
    import rerun

    monkeypatch.setenv("RERUN_STRICT", "1")
    rerun.set_strict_mode(True)


def reach(seed: int = 5) -> Rollout:
    """Play an episode of reach that goes straight to the goal, by inverse kinematics."""
    spec = EnvSpec("reach")
    with closing(make_drawable(spec)) as env:
        task, sim = env.unwrapped.task, env.unwrapped.sim

        def choose(observation, step):
            arm = sim.body("arm")
            wanted = pybullet.calculateInverseKinematics(
                arm.id, HAND, task.goal.tolist(), maxNumIterations=100, physicsClientId=sim.client
            )
            return np.clip((np.array(wanted) - arm.joint_positions) / JOINT_STEP, -1, 1).astype(np.float32)

        return play_episode(env, spec, seed, choose, policy="inverse kinematics", draw=print)


def play(name: str, *, seed: int = 3, **parameters) -> tuple[Rollout, list[str]]:
    """Play an episode of an environment of envs.py with random actions; returns also the warnings."""
    spec, warnings = EnvSpec(f"{ENVS}:{name}", parameters), []
    with closing(make_drawable(spec)) as env:
        env.action_space.seed(0)
        rollout = play_episode(
            env, spec, seed, lambda o, k: env.action_space.sample(), policy="chance", draw=warnings.append
        )
    return rollout, warnings


@pytest.fixture(scope="session")
def reached() -> Rollout:
    return reach()


@pytest.fixture(scope="session")
def episode_file(reached, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("episodes") / "000007.npz"
    save_episode(path, reached.episode)
    return path


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A run of reach that was trained for a moment, with one recording."""
    from rlctl.launching.train import run_training
    from rlctl.runs.train_request import TrainRequest

    settings = {
        "n_envs": 4,
        "total_timesteps": 64,
        "algo_kwargs": {"n_steps": 16, "batch_size": 32, "n_epochs": 1},
        "eval": {"episodes": 2},
    }
    return run_training(
        TrainRequest("reach", settings=settings, root=tmp_path_factory.mktemp("runs"), record=1, check=False)
    )


@pytest.fixture
def replay(rlctl):
    """Run `rlctl replay` in an empty folder, without a display."""

    def call(*arguments, display: str = ""):
        environment = {"RERUN_STRICT": "1", "DISPLAY": display, "WAYLAND_DISPLAY": ""}
        return rlctl("replay", *arguments, env=environment)

    return call


def as_json(done: subprocess.CompletedProcess) -> dict:
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
