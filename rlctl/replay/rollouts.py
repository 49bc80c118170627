"""New episodes of a policy, lived one after the other in one environment."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl.env_spec import EnvSpec
from rlctl.replay.live import Choose, Env
from rlctl.run.env_info import describe
from rlctl.run.policy import Policy, load_policy


@dataclasses.dataclass(frozen=True)
class Actor:
    """A policy and what it acts in."""

    file: Path
    policy: Policy
    spec: EnvSpec

    @property
    def name(self) -> str:
        """What chose the actions, for people."""
        info = self.policy.info
        return f"{self.file.name}, {info.algo}, step {info.training_steps:,}"

    def check_fits(self, env: Env) -> None:
        """Raise `ArtifactError` if the policy was made for other spaces than the environment has."""
        self.policy.info.check_fits(describe(env), self.file)

    def episode(self) -> Choose:
        """Begin an episode; returns what chooses its actions."""
        self.policy.reset()
        return lambda observation, _: self.policy.predict(observation)


def load_actor(file: Path, task: str | None, parameters: Mapping[str, Any]) -> Actor:
    """Load a policy, to act in the task it was trained on or in `task`, with parameters put over the task's."""
    if file.suffix == ".safetensors":
        from rlctl.run.torch_policy import pin_threads

        pin_threads()
    policy = load_policy(file)
    return Actor(file, policy, policy.info.env_spec(task, parameters))
