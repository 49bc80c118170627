from pathlib import Path

import pytest

from rlctl.errors import TaskError
from rlctl.launching.train import TrainResult, run_training
from rlctl.play.seeds import Stream, episode_seed
from rlctl.recipe import recipe
from rlctl.runs.directory import RunDirectory
from rlctl.runs.train_request import TrainRequest
from rlctl.training import checkpoints
from rlctl.training.rollouts import WorkerVecEnv
from tests.training.comparing import Killed

ENVS = Path(__file__).with_name("envs.py")
FAULTY = ENVS.with_name("faulty_envs.py")
FAULTY_SEED = episode_seed(0, Stream.TRAIN, 1, 3)
"""Of the fourth episode of the second environment: its seventh step is the 37th of them, in the third rollout."""

SMALL = {
    "n_envs": 4,
    "total_timesteps": 256,
    "eval": {"episodes": 6, "every_steps": 128},
}
TINY = {
    "n_envs": 2,
    "total_timesteps": 128,
    "eval": {"episodes": 1, "every_steps": 1_000_000},
    "algo_kwargs": {"n_steps": 16, "batch_size": 32, "n_epochs": 1},
}
SMALL_PPO = {**SMALL, "algo_kwargs": {"n_steps": 16, "batch_size": 32, "n_epochs": 2}}


@pytest.fixture
def train(tmp_path: Path):
    """Train on an environment of envs.py in this process, into a temporary folder."""

    def run(env: str, settings: dict, envs: str | Path = ENVS, **request) -> TrainResult:
        task = f"{envs}:{env}" if env[0].isupper() else env
        return run_training(
            TrainRequest(task, settings=settings, root=tmp_path / "runs", **{"check": False, **request})
        )

    return run


@pytest.fixture
def resume(tmp_path: Path):
    def run(run: TrainResult | RunDirectory, *, force=False, device="cpu", **settings) -> TrainResult:
        path = run.path if isinstance(run, RunDirectory) else run.run.path
        request = TrainRequest(
            resume=str(path), settings=settings, root=tmp_path / "runs", force=force, device=device, check=False
        )
        return run_training(request)

    return run


@pytest.fixture
def small_ppo() -> dict:
    return recipe.merge(SMALL_PPO, {})


@pytest.fixture
def every_boundary(monkeypatch):
    """Write a checkpoint at every boundary, whatever it costs."""
    monkeypatch.setattr(checkpoints, "CHECKPOINT_TIME_SHARE", 1e9)


@pytest.fixture
def fail(train, tmp_path):
    """Train into a fault; return the error and the run."""

    def run(env="Faulty", settings=TINY, timeout_s=60.0, **parameters):
        task = {"faulty_seed": FAULTY_SEED, **parameters}
        with pytest.raises(TaskError) as caught:
            train(env, {**settings, "task": task}, envs=FAULTY, env_timeout_s=timeout_s)
        (folder,) = (tmp_path / "runs").glob("*/2*")
        return caught.value, RunDirectory(folder)

    return run


@pytest.fixture
def kill_after(monkeypatch):
    """End the training in the middle of a step, so many steps of each environment after it began."""

    def kill(steps):
        done = asked = 0
        started, finished = WorkerVecEnv.start, WorkerVecEnv.finish

        def killed():
            raise Killed

        def start(env, count, exploration):
            nonlocal asked
            asked = count
            started(env, count, exploration)

        def finish(env, watch=None):
            nonlocal done
            segment = finished(env, killed if done + asked > steps else watch)  # while the workers play
            done += segment.reward.shape[1]
            return segment

        def undo():
            monkeypatch.setattr(WorkerVecEnv, "start", started)
            monkeypatch.setattr(WorkerVecEnv, "finish", finished)

        monkeypatch.setattr(WorkerVecEnv, "start", start)
        monkeypatch.setattr(WorkerVecEnv, "finish", finish)
        return undo

    return kill
