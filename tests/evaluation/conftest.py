"""Policies that do nothing, in runs that nobody trained."""

import json
from pathlib import Path

import numpy as np
import pytest

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.runs.directory import RunDirectory
from tests.play.policies import linear

ENVS = Path(__file__).with_name("envs.py")


def write_run(folder: Path, task: str) -> RunDirectory:
    """Write a run whose policy takes the action 0."""
    spec = EnvSpec(task)
    env = spec.make()
    try:
        policy = linear(describe(env), np.zeros((env.action_space.shape[0], env.observation_space.shape[0])), 0.0)
    finally:
        env.close()
    run = RunDirectory(folder)
    run.best_policy.parent.mkdir(parents=True)
    run.status_file.write_text(json.dumps({"task": task, "status": "finished", "algo": "ppo", "seed": 0}))
    policy.with_info(spec=spec).write(run.best_policy)
    return run


@pytest.fixture(scope="session")
def block_run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("block") / "run", f"{ENVS}:Block")
