from pathlib import Path

import pytest

from rlctl.run import recipe
from rlctl.run.directory import RunDirectory
from rlctl.train.request import TrainRequest, TrainResult, run_training

ENVS = Path(__file__).with_name("envs.py")

SMALL = {
    "n_envs": 4,
    "total_timesteps": 256,
    "eval": {"episodes": 6, "every_steps": 128},
}
SMALL_PPO = {**SMALL, "algo_kwargs": {"n_steps": 16, "batch_size": 32, "n_epochs": 2}}


@pytest.fixture
def train(tmp_path: Path):
    """Train on an environment of envs.py in this process, into a temporary folder."""

    def run(env: str, settings: dict, envs: str | Path = ENVS, **request) -> TrainResult:
        task = f"{envs}:{env}" if env[0].isupper() else env
        return run_training(TrainRequest(task, settings=settings, root=tmp_path / "runs", **request))

    return run


@pytest.fixture
def resume(tmp_path: Path):
    def run(run: TrainResult | RunDirectory, *, force=False, **settings) -> TrainResult:
        path = run.path if isinstance(run, RunDirectory) else run.run.path
        return run_training(
            TrainRequest(None, resume=str(path), settings=settings, root=tmp_path / "runs", force=force)
        )

    return run


@pytest.fixture
def small_ppo() -> dict:
    return recipe.merge(SMALL_PPO, {})
