"""Callbacks read, log, stop and change a training; a resume is exact; a fault in one loses nothing."""

import csv
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rlctl.cli.train import TrainFlags
from rlctl.errors import Interrupted, RecipeError, TaskError, UsageError
from rlctl.policy import own_modules
from rlctl.recipe.recipe import validate
from rlctl.runs.directory import RunDirectory
from rlctl.runs.train_request import TrainRequest
from tests.training import own_callbacks
from tests.training.comparing import Killed, assert_same_run
from tests.training.conftest import SMALL_PPO
from tests.training.test_exact_resume import settings

FILE = Path(own_callbacks.__file__)
SB3 = FILE.with_name("sb3_callbacks.py")
ADAPTIVE = {"callbacks": {f"{FILE}:Adaptive": None}}


@pytest.fixture
def run_of(tmp_path):
    """Return the newest run, also of a training that raised."""

    def find():
        return RunDirectory(max((tmp_path / "runs").glob("*/2*"), key=lambda path: path.stat().st_mtime_ns))

    return find


def read(table: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(table.open()))


def test_a_callback_logs_changes_the_rate_and_stops(train):
    run = train("Line", {**SMALL_PPO, "callbacks": {f"{FILE}:Adaptive": {"rate": 0.1, "stop_after": 128}}}).run
    rows = read(run.metrics_file)
    assert [row["steps"] for row in rows] == ["64", "128"]
    # Half of 0.1 at the start; a segment's change comes after its updates.
    assert [float(row["learning_rate"]) for row in rows] == pytest.approx([0.05, 0.04], rel=0.13)
    assert rows[0]["callback/evaluated"] == ""
    assert float(rows[1]["callback/lengths"]) > 0
    assert [row["steps"] for row in read(run.evals_file)] == ["128"]
    assert (run.path / "end.txt").exists()
    assert run.status()["status"] == "finished"
    assert run.status()["stop_reason"] == "enough"


@pytest.mark.parametrize("name", ["os:system", "subprocess:run", "shutil:rmtree", "pathlib:Path"])
def test_what_is_no_callback_is_not_called(train, tmp_path, name):
    """A recipe may come from somebody else."""
    arguments = {"command": f"touch {tmp_path / 'called'}"}
    with pytest.raises(RecipeError, match=f"callbacks: {name}: neither a rlctl.Callback nor a BaseCallback"):
        train("Line", {**SMALL_PPO, "callbacks": {name: arguments}})
    assert not (tmp_path / "called").exists()


@pytest.mark.slow
def test_a_downloaded_run_imports_no_callback(train, resume, monkeypatch):
    run = train("Line", {**SMALL_PPO, "callbacks": {f"{FILE}:Adaptive": {}}}).run
    monkeypatch.setattr("rlctl.hub.store._cache", lambda: run.path.parent)
    with pytest.raises(UsageError, match="a run that was downloaded imports nothing"):
        resume(run)


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["ppo", "sac"])
@pytest.mark.usefixtures("every_boundary")
def test_resume_is_exact_with_a_schedule_that_a_callback_changes(train, resume, kill_after, run_of, capsys, algo):
    given = {**settings(algo), **ADAPTIVE}
    whole = train("Line", given).run
    undo = kill_after(20 if algo == "ppo" else 13)
    with pytest.raises(Killed):
        train("Line", given)
    undo()
    run = run_of()
    assert int(run.checkpoints()[-1].name) > 0
    resume(run)
    assert ", bit-exact" in capsys.readouterr().err
    assert_same_run(whole, run)
    assert (whole.path / "end.txt").read_text() == (run.path / "end.txt").read_text()


@pytest.mark.slow
def test_state_that_is_no_plain_data_is_reported(train, resume, run_of, capsys):
    with pytest.raises(TaskError):
        train("Line", {**SMALL_PPO, "callbacks": {f"{FILE}:Unsaved": None, f"{FILE}:Raises": None}})
    problem = "Unsaved: its window is a set, which a checkpoint does not store"
    assert f"{problem}; a resume will not be bit-exact; see docs/callbacks.md" in capsys.readouterr().err
    with pytest.raises(TaskError):
        resume(run_of())
    assert re.search(f"resuming at step 0, not bit-exact: callback .*{problem}", capsys.readouterr().err)


@pytest.mark.slow_except("on_start")
@pytest.mark.parametrize("moment", ["on_start", "on_segment", "on_evaluation", "on_checkpoint", "on_end"])
@pytest.mark.usefixtures("every_boundary")
def test_a_callback_that_raises(train, run_of, moment):
    arguments = {"moment": moment, "step": 0 if moment == "on_start" else 128}
    with pytest.raises(TaskError) as caught:
        train("Line", {**SMALL_PPO, "callbacks": {f"{FILE}:Raises": arguments}})
    step = {"on_start": 0, "on_end": 256}.get(moment, 128)
    line, *hint = str(caught.value).splitlines()
    assert (
        line
        == f"callback '{FILE}:Raises': {moment} at step {step}: KeyError: 'bonus' (tests/training/own_callbacks.py:59)"
    )
    assert caught.value.exit_code == 3
    saved = {"on_start": None, "on_end": 256, "on_checkpoint": 128}.get(moment, 64)
    assert [int(folder.name) for folder in run_of().checkpoints()][-1:] == ([] if saved is None else [saved])
    if 0 < (saved or 0) < 256:
        assert hint == [f"checkpoint at step {saved} is intact; resume with: rlctl train --resume {run_of().path}"]
    assert run_of().status()["status"] == "failed"


@pytest.mark.usefixtures("every_boundary")
def test_a_callback_that_never_returns_is_interrupted(train, run_of):
    with pytest.raises(
        Interrupted, match=r"interrupted in callback .*NeverReturns, on_segment; the last checkpoint is"
    ):
        train("Line", {**SMALL_PPO, "callbacks": {f"{FILE}:NeverReturns": None}})
    assert run_of().status()["status"] == "interrupted"
    assert [int(folder.name) for folder in run_of().checkpoints()] == [0]


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("missing.py:Adaptive", "no file .*missing.py"),
        (f"{FILE}:Adaptiv", "has no 'Adaptiv'.*Did you mean 'Adaptive'"),
        ("Adaptive", "give the class too: FILE.py:CLASS or MODULE:CLASS"),
        (f"{FILE}:make_nothing", "neither a rlctl.Callback nor a BaseCallback"),
        ("json:JSONDecoder", "neither a rlctl.Callback nor a BaseCallback"),
    ],
)
def test_a_wrong_name_is_a_recipe_error(train, tmp_path, name, problem):
    with pytest.raises(RecipeError, match=f"callbacks: .*{problem}"):
        train("Line", {**SMALL_PPO, "callbacks": {name: None}})
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_a_file_of_another_machine_is_found_beside_its_recipe(train, tmp_path, monkeypatch):
    (tmp_path / "count.py").write_text("import rlctl\n\n\nclass Count(rlctl.Callback):\n    pass\n")
    monkeypatch.chdir(tmp_path)
    run = train("Line", {**SMALL_PPO, "callbacks": {"/another/machine/count.py:Count": None}}).run
    assert list(run.recipe().callbacks) == [f"{tmp_path}/count.py:Count"]


@pytest.mark.slow
def test_the_example_of_the_page(train, tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "callbacks.md").read_text()
    (code,) = re.findall(r"`my\.py`:\n\n```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "my.py").write_text(code)
    given = {**SMALL_PPO, "eval": {"episodes": 1, "every_steps": 64}, "total_timesteps": 1024}
    run = train("Line", {**given, "callbacks": {f"{tmp_path}/my.py:Patience": {"factor": 0.7}}}).run
    returns = [float(row["return"]) for row in read(run.evals_file)]
    rates = {float(row["learning_rate"]) for row in read(run.metrics_file)}
    best, failures = float("-inf"), 0
    for value in returns:
        best, failures = (value, 0) if value > best else (best, failures + 1)
    assert rates >= {3e-4}
    assert (failures == 3) == ("stop_reason" in run.status())


def test_the_flag_is_a_key_of_the_recipe_and_part_of_the_request():
    flags = TrainFlags(settings=["callbacks={a.py:A: {b: 1}}"], callback=["a.py:C", "d:E"])
    request = TrainRequest("reach", settings=flags.merge())
    names = {"a.py:A": {"b": 1}, "a.py:C": None, "d:E": None}
    assert TrainRequest.from_json(request.to_json()).settings == {"callbacks": names}
    recipe = own_modules.locate(validate(request.settings))
    assert list(recipe.callbacks) == [f"{Path.cwd()}/a.py:A", f"{Path.cwd()}/a.py:C", "d:E"]


@pytest.mark.slow
def test_wrong_arguments_and_parameters_are_named(train):
    with pytest.raises(TaskError, match=r"callback .*Adaptive': TypeError: .*unexpected keyword argument 'speed'"):
        train("Line", {**SMALL_PPO, "callbacks": {f"{FILE}:Adaptive": {"speed": 1}}})
    with pytest.raises(TaskError, match=r"on_start at step 0: ValueError: set_parameter\('gamma', 0.5\): set one of"):
        train("Line", {**SMALL_PPO, "callbacks": {f"{FILE}:WrongParameter": None}})


@pytest.mark.slow
def test_a_callback_whose_file_has_changed_needs_force(train, resume, tmp_path, capsys):
    file = Path(shutil.copy(FILE, tmp_path / "mine.py"))
    run = train("Line", {**SMALL_PPO, "callbacks": {f"{file}:Adaptive": {"stop_after": 64}}}).run
    file.write_text(f"{file.read_text()}\n")
    with pytest.raises(UsageError, match=r"mine.py has changed since the run began.*--force resumes anyway"):
        resume(run, total_timesteps=320)
    resume(run, force=True, total_timesteps=320)
    assert "not bit-exact: " in capsys.readouterr().err


@pytest.mark.slow
def test_callbacks_of_stable_baselines3(train, tmp_path):
    folder = {"folder": str(tmp_path)}
    four = {"evaluation": folder, "several": folder, "Worst": None, "convert": None}
    run = train("Line", {**SMALL_PPO, "callbacks": {f"{SB3}:{name}": given for name, given in four.items()}}).run
    # It ends at the first boundary (64 steps each) after the step at which `convert` returns False.
    assert run.status()["stop_reason"] == "ConvertCallback at step 92"
    assert run.checkpoints()[-1].name.lstrip("0") == "128"
    # Every 8, 24 and 100 steps of the four environments: a segment has 16 steps of each.
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [32, 64, 96, 128]
    assert {file.name for file in tmp_path.glob("*.zip")} == {"rl_model_96_steps.zip", "every_100_steps.zip"}
    written = EventAccumulator(str(run.tensorboard)).Reload().Scalars("own/worst")
    assert [event.step for event in written] == [64, 128]


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["ppo", "sac"])
@pytest.mark.usefixtures("every_boundary")
def test_resume_is_exact_with_a_callback_of_stable_baselines3(train, resume, kill_after, run_of, capsys, algo):
    given = {**settings(algo), "callbacks": {f"{SB3}:Worst": None}}
    whole = train("Line", given).run
    ends = [line for line in capsys.readouterr().out.splitlines() if line.startswith("checked")]
    undo = kill_after(20 if algo == "ppo" else 13)
    with pytest.raises(Killed):
        train("Line", given)
    undo()
    resume(run_of())
    output = capsys.readouterr()
    assert ", bit-exact" in output.err
    assert [line for line in output.out.splitlines() if line.startswith("checked")] == ends
    assert_same_run(whole, run_of())


@pytest.mark.slow
def test_a_schedule_that_sb3_callbacks_replace_is_reported(train, capsys):
    train("Line", {**SMALL_PPO, "callbacks": {f"{SB3}:NewSchedule": None}})
    assert "NewSchedule: its model.lr_schedule is a function, which a checkpoint does not" in capsys.readouterr().err


@pytest.mark.slow
def test_a_callback_cannot_reach_into_the_environments(train):
    with pytest.raises(TaskError, match=r"on_segment at step 64: AttributeError: methods of environments in workers"):
        train("Line", {**SMALL_PPO, "callbacks": {f"{SB3}:ReachesIn": None}})
