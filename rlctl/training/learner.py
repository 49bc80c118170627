"""The learner: model, environments, curriculum and progress of a training."""

import time
from typing import Any

from rlctl.policy.file import PolicyFile
from rlctl.recipe.recipe import Recipe
from rlctl.training.curriculum import Curriculum, begin_next_episodes
from rlctl.training.progress import Progress
from rlctl.training.rollouts import Rollouts
from rlctl.training.snapshot import pack


class Learner:
    """The model, its environments, the curriculum, and the progress, which checkpoints store."""

    def __init__(self, recipe: Recipe, rollouts: Rollouts, curriculum: Curriculum, progress: Progress) -> None:
        self.recipe = recipe
        self.rollouts = rollouts
        self.curriculum = curriculum
        self.progress = progress
        self.model: Any = rollouts.model
        self.env = rollouts.env
        self._started_s = time.monotonic()

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.model.num_timesteps)

    @property
    def is_at_end(self) -> bool:
        """Whether the recipe's steps are done, or a callback has ended the training."""
        return self.steps >= self.recipe.total_timesteps or bool(self.progress.stop_reason)

    @property
    def seconds(self) -> float:
        """Seconds of training so far, including those before a resume."""
        return time.monotonic() - self._started_s

    def start_clock(self) -> None:
        """Count the seconds of training from now on."""
        self._started_s = time.monotonic() - self.progress.seconds

    def pack(self) -> PolicyFile:
        """Return the current policy, with the last stage of the curriculum as its environment."""
        policy = pack(self.model, self.recipe.algo, self.curriculum.goal_spec, self.curriculum.goal)
        return policy.with_info(stages=self.curriculum.specs())

    def begin_next_stage(self) -> tuple[str, str]:
        """Cut the running episodes short and begin the next stage; return its title and the reason."""
        self.env.workers.rebuild(self.curriculum.next_spec())
        begin_next_episodes(self.model)
        return self.curriculum.enter_next_stage(self.steps)
