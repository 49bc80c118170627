"""What must hold after a fault, whatever it was."""

import csv
from pathlib import Path

from rlctl.policy.file import PolicyFile
from rlctl.run.directory import RunDirectory
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
        assert again.went_on_at >= announced
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
    """Hold that the best policy is at least as good as each evaluation there is a row of.

    Success is the same in all of them. The last policy may be the best by new episodes, whatever its row says.
    """
    info = PolicyFile.read(run.best_policy).info if (evals := whole_rows(run.evals_file)) else None
    if info is None or info.training_steps == run.recipe().total_timesteps:
        return
    score = info.evaluation
    best = max((float(row["success"]), float(row["return"])) for row in evals)
    assert (score.success, score.mean_return) >= best


def whole_rows(file: Path) -> list[dict[str, str]]:
    """Return the rows of a table without the half of one that a disk took last: a resume cuts it off."""
    text = file.read_text() if file.exists() else ""
    return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))


def assert_tidy(run: RunDirectory) -> None:
    """Hold that nothing half-written is left in a run that has ended well."""
    assert [path for path in run.path.rglob("*.part*") if path.is_file()] == []
