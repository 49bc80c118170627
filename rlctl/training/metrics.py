"""The rows of `metrics.csv`, and the same numbers for TensorBoard and the display."""

import time
from typing import Any

from rlctl.recipe.recipe import ON_POLICY
from rlctl.rollout.messages import EpisodeResult
from rlctl.training import measurements
from rlctl.training.checkpoints import Checkpoints
from rlctl.training.display import Display
from rlctl.training.learner import Learner
from rlctl.training.snapshot import check_finite

_OFF_POLICY_ROWS = 200  # approximate number of rows: off-policy updates come at every step


class Metrics:
    """Collects finished training episodes, and writes a row about them and the updates."""

    def __init__(self, learner: Learner, checkpoints: Checkpoints, display: Display) -> None:
        self._learner = learner
        self._checkpoints = checkpoints
        self._display = display
        self._last_row_s, self._last_row_steps = time.monotonic(), learner.steps

    def collect_finished_episodes(self) -> list[EpisodeResult]:
        """Take finished episodes from the environments and return them; count observations outside their space."""
        env, progress = self._learner.env, self._learner.progress
        finished, env.ended = env.ended, []
        progress.recent += finished
        self._learner.curriculum.count(finished)
        if env.outside and not progress.observations_outside:
            self._display.message(f"warning: {env.outside_message}; such observations are counted and used unchanged")
        progress.observations_outside += env.outside
        env.outside = 0
        return finished

    def is_due(self) -> bool:
        """Return whether to write a row: after every rollout of an on-policy algorithm, else at intervals."""
        steps = self._learner.steps
        return self._learner.recipe.algo in ON_POLICY or steps >= self._learner.progress.next_row

    def measure(self) -> dict[str, Any]:
        """Return the row about the steps since the last one; empty if there were none."""
        learner, progress = self._learner, self._learner.progress
        steps, logger, env = learner.steps, learner.model.logger, learner.env
        if steps <= progress.last_row:
            return {}
        check_finite(learner.model, self._checkpoints.run.path)
        now = time.monotonic()
        elapsed_s = max(now - self._last_row_s, 1e-9)
        recent, progress.recent = progress.recent, []
        row = {
            "steps": steps,
            "seconds": round(learner.seconds, 3),
            "fps": round((steps - self._last_row_steps) / elapsed_s, 1),
            "playing": round(env.waited_s / elapsed_s, 3),
            **learner.curriculum.columns(),
            **measurements.training_row(recent, env.workers.info.reward_weights, logger.name_to_value),
            **measurements.measure(learner.model, env, progress.last_row, learner.recipe.total_timesteps),
        }
        self._last_row_s, self._last_row_steps, env.waited_s = now, steps, 0.0
        return row

    def write(self, row: dict[str, Any]) -> None:
        """Write a row of `measure`, and what callbacks have logged, to `metrics.csv` and TensorBoard."""
        learner, progress, logger = self._learner, self._learner.progress, self._learner.model.logger
        logged, progress.logged = progress.logged, {}
        row |= logged
        self._checkpoints.row(self._checkpoints.metrics, row)
        for name, value in (measurements.tensorboard_values(row) | logged).items():
            logger.record(name, value)
        learner.model.dump_logs()
        self._display.metrics(row)
        progress.last_row = learner.steps
        progress.next_row = learner.steps + max(1, learner.recipe.total_timesteps // _OFF_POLICY_ROWS)

    def exclude(self, seconds: float) -> None:
        """Exclude the time of an evaluation from the training rate."""
        self._last_row_s += seconds
