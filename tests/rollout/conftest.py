from pathlib import Path

import pytest

from rlctl.env_spec import EnvSpec
from rlctl.rollout.workers import Workers

ENVS = Path(__file__).with_name("envs.py")


@pytest.fixture
def spec():
    """Return the spec of an environment of envs.py."""

    def of(name: str, **parameters) -> EnvSpec:
        return EnvSpec(f"{ENVS}:{name}", parameters)

    return of


@pytest.fixture
def start():
    """Start workers that are closed at the end."""
    started = []

    def make(spec: EnvSpec, n_envs: int, **options) -> Workers:
        started.append(Workers(spec, n_envs, **options))
        return started[-1]

    yield make
    for workers in started:
        workers.close()
