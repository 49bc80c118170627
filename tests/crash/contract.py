"""What must hold after a fault, whatever it was."""

import csv
from pathlib import Path

import pytest

from rlctl.policy.file import PolicyFile
from rlctl.runs.directory import RunDirectory
from tests.crash.trials import Ended, Trials, only_run, resume
from tests.training.comparing import assert_same_run


def assert_nothing_lost(trials: Trials, arguments, ended: Ended, whole: RunDirectory, announced=0) -> None:
    """Resume what a fault has ended, without faults, and compare it to a training that had none.

    `announced` is the step of the last checkpoint that was announced before the command that the fault has ended.
    """
    announced = max(announced, ended.announced)
    assert ended.orphans == []
    run = only_run(ended.folder)
    if run is None:  # ended before there was a run: the next one is a new one
        assert announced == 0
        again = trials.run(arguments, ended.folder)
    else:
        assert_best_is_best(run)
        again = trials.run(resume(run), ended.folder)
    assert again.code == 0, again.stderr
    assert_quiet(again)
    if "nothing to do" not in again.stdout + again.stderr:
        assert again.resumed_at >= announced
    assert_same_end(only_run(ended.folder), whole)


def assert_same_end(run: RunDirectory, whole: RunDirectory) -> None:
    """Hold that a run has ended as another one: bit by bit, and tidily."""
    assert run.status()["status"] == "finished"
    assert_same_run(whole, run)
    ours, theirs = PolicyFile.read(run.last_policy).tensors, PolicyFile.read(whole.last_policy).tensors
    assert {name: values.tobytes() for name, values in ours.items()} == {
        name: values.tobytes() for name, values in theirs.items()
    }
    assert PolicyFile.read(run.best_policy).info == PolicyFile.read(whole.best_policy).info


def assert_quiet(ended: Ended) -> None:
    """Hold that nobody sees a traceback, and that no process is left."""
    assert ended.orphans == []
    assert "Traceback" not in ended.stderr
    assert ended.code != 70


def assert_best_is_best(run: RunDirectory) -> None:
    """Check that the best policy has the highest score of all evaluations, or is the last policy.

    All success rates of this recipe are equal, so the return decides. At its end a training plays new episodes with
    the best and the last policy, and the better one is kept as best. The last policy may win with a lower score in
    its evaluation, because the highest of many scores is partly luck. Its file then has its evaluation's score.
    """
    rows = {int(row["steps"]): _read_score(row) for row in whole_rows(run.evals_file)}
    if not rows:
        return
    info = PolicyFile.read(run.best_policy).info
    score = (info.evaluation.success, info.evaluation.mean_return)
    if info.training_steps == run.recipe().total_timesteps:
        assert info.training_steps not in rows or score == pytest.approx(rows[info.training_steps])
    else:
        assert score >= max(rows.values())


def _read_score(row: dict[str, str]) -> tuple[float, float]:
    return float(row["success"]), float(row["return"])


def whole_rows(file: Path) -> list[dict[str, str]]:
    """Return the rows of a table without the half of one that a disk took last: a resume cuts it off."""
    text = file.read_text() if file.exists() else ""
    return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))


def assert_tidy(run: RunDirectory) -> None:
    """Hold that nothing half-written is left in a run that has ended well."""
    assert [path for path in run.path.rglob("*.part*") if path.is_file()] == []
