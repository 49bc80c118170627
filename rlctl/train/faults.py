"""What a training reports and stores of an environment that failed."""

from __future__ import annotations

from pathlib import Path

from rlctl.env_spec import EnvSpec
from rlctl.errors import EpisodeFailed, RlctlError, TaskError
from rlctl.run.directory import RunDirectory
from rlctl.train.episodes import EpisodeKeeper
from rlctl.train.saving import Saver
from rlctl.train.vec_env import WorkerVecEnv


def explain_fault(
    error: TaskError, run: RunDirectory, env: WorkerVecEnv, saver: Saver, keeper: EpisodeKeeper
) -> TaskError:
    """Keep the actions of the training episode that failed, and return the error with what to do next."""
    if isinstance(error, EpisodeFailed) and error.actions is None:
        actions = env.history.of(error.env)
        # A reset that fails is that of the next episode: none of the actions is its own.
        error.actions = None if actions is None else actions[: error.step]
    lines = [str(keep_episode(error, env.workers.spec, saver, keeper))]
    if saver.saved_step:  # at step 0 there is nothing to keep
        lines.append(f"the checkpoint of step {saver.saved_step:,} stands; go on with: rlctl train --resume {run.path}")
    return TaskError("\n".join(lines), details=error.details)


def keep_episode(
    error: RlctlError, spec: EnvSpec, saver: Saver, keeper: EpisodeKeeper, evaluated_at: int | None = None
) -> RlctlError:
    """Write the actions of an episode that failed, if they are known; return the error, with the file in its hint."""
    if not isinstance(error, EpisodeFailed) or error.actions is None:
        return error
    files: list[Path] = []
    saver.attempt("failed episode", lambda: files.append(keeper.keep_failed(spec, error, evaluated_at)))
    return error.with_hint(f"to reproduce it: rlctl replay {files[0]}") if files else error
