"""A run folder that is resumed, put back to where its checkpoint was taken."""

from __future__ import annotations

from rlctl.errors import ArtifactError
from rlctl.run import files
from rlctl.run.directory import RunDirectory
from rlctl.run.policy import read_policy
from rlctl.run.table import Table
from rlctl.train.episodes import remove_after
from rlctl.train.progress import Progress


def cut_back(run: RunDirectory, step: int, progress: Progress) -> list[str]:
    """Put a run folder back to where the checkpoint of a step has it; return warnings.

    Tables are cut back, checkpoints that are damaged are set aside, and the best policy stays the best there is.
    """
    for folder in run.checkpoints():
        if int(folder.name) > step:
            files.set_aside(folder)
    remove_after(run, step)
    warnings = []
    for file, size, sha256 in (
        (run.metrics_file, progress.metrics_bytes, progress.metrics_sha256),
        (run.evals_file, progress.evals_bytes, progress.evals_sha256),
    ):
        table = Table(file)
        if not table.cut_back(size):
            warnings.append(
                f"warning: {file}: rows before step {step:,} are gone: it is shorter than the checkpoint says"
            )
        elif size and table.digest() != sha256:
            warnings.append(
                f"warning: {file}: damaged, or edited: rows before step {step:,} are not those that were written"
            )
    return warnings + _read_best_score(run, progress)


def _read_best_score(run: RunDirectory, progress: Progress) -> list[str]:
    """Take the score from the best policy's own file, which may be newer than the checkpoint.

    Return a warning if it is not as good as the checkpoint says.
    """
    best_step, problem = progress.best_step, ""
    score = (progress.best_success or 0.0, progress.best_return or 0.0)
    progress.best_success = progress.best_return = progress.best_step = None
    try:
        info, _ = read_policy(run.best_policy)
    except ArtifactError as error:
        problem = str(error)
    else:
        if info.evaluation is not None:
            progress.best_success, progress.best_return = info.evaluation.success, info.evaluation.mean_return
            progress.best_step = info.training_steps
        if progress.best_step is None or (progress.best_success or 0.0, progress.best_return or 0.0) < score:
            problem = f"{run.best_policy}: not the best policy, but that of step {info.training_steps:,}"
    if best_step is None or not problem:
        return []
    return [f"warning: {problem}; the best one was that of step {best_step:,}, and is lost unless a checkpoint has it"]
