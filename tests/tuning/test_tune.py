"""`rlctl tune`: what is tried, what is kept, what is stopped, and a tuning that goes on after an interruption.

Trainings are played by a function that writes what a run would; one test trains.
"""

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import optuna
import pytest
import yaml

from rlctl.errors import ArtifactError, Interrupted, RecipeError, TaskError, UsageError
from rlctl.launching.trainings import Trainings
from rlctl.play.episode import load_episode
from rlctl.runs import directory
from rlctl.runs.directory import RunDirectory, is_being_written
from rlctl.runs.group import read_group
from rlctl.runs.listing import list_runs, plan_removal
from rlctl.runs.lookup import find_run
from rlctl.tuning.tune import tune
from rlctl.tuning.tune_request import TuneRequest
from rlctl.tuning.tuning import load
from tests.training.conftest import ENVS, TINY

LINE = f"{ENVS}:Line"
BEST_RATE = 1e-3
RATES = "algo_kwargs.learning_rate=1e-5:1e-1"


class PlayedTrainings:
    """Takes the place of `Trainings.train`: a run whose return is the better, the nearer its values are to the best."""

    def __init__(self, monkeypatch):
        self.calls, self.fails, self.interrupts_at = [], lambda settings: False, None
        self.killed_at = None
        self.success = "0.5"
        self.lock = threading.Lock()
        monkeypatch.setattr(Trainings, "train", lambda trainings, *arguments: self.train(trainings, *arguments))

    def train(self, trainings, request, receive, is_hopeless=None):
        with self.lock:
            self.calls.append(request)
        if request.resume is not None:
            run = RunDirectory(Path(request.resume))
            settings = run.status()["settings"]
        else:
            settings = request.settings
            run = directory.create(LINE, settings["seed"], request.root)
        run.write_status({"task": LINE, "status": "running", "settings": settings})
        run.checkpoint(64).mkdir(parents=True, exist_ok=True)
        if self.killed_at == len(self.calls):
            return 137
        if self.interrupts_at == len(self.calls):
            trainings.stopped_by = signal.SIGINT
            return 130
        if self.fails(settings):
            receive("some line")
            receive("error: it diverged")
            receive("at step 3")
            return 4
        kwargs = settings.get("algo_kwargs", {})
        score = -abs(kwargs.get("learning_rate", 3e-4) - BEST_RATE) - abs(kwargs.get("gamma", 0.9) - 0.98)
        rows = ["steps,success,return"]
        for step in range(1, 7):
            rows.append(f"{step * 100},{self.success},{score * (10 - step)}")
            run.evals_file.write_text("\n".join(rows) + "\n")
            if is_hopeless is not None and is_hopeless():
                receive("error: interrupted at step 3; checkpoint saved")
                return 130
        run.write_status({"status": "finished"})
        return 0


@pytest.fixture
def played(monkeypatch):
    return PlayedTrainings(monkeypatch)


def begin(tmp_path, *search, jobs=1, **options):
    """Tune with so many `trials` besides the first, which is the recipe as it is."""
    settings = {**TINY, **options.pop("settings", {})}
    options["trials"] = options.get("trials", 8) + 1
    return tune(TuneRequest(LINE, settings=settings, search=list(search), root=tmp_path / "runs", **options), jobs=jobs)


def resume(folder, jobs=None):
    return tune(TuneRequest(resume=str(folder)), jobs=jobs)


@pytest.mark.slow
def test_the_best_of_all_trials_is_a_recipe(played, tmp_path, rlctl):
    tuning = begin(tmp_path, RATES, trials=12)
    rates = [each.values["algo_kwargs.learning_rate"] for each in tuning.trials[1:]]
    assert len(rates) == len(set(rates)) == 12
    assert tuning.trials[0].values == {}
    best = tuning.best
    assert best.score == max(each.score for each in tuning.trials if each.state == "done")
    # The mean of the last two of six evaluations, of 5 and 4 times the distance from the best rate and discount.
    distance = abs(best.values["algo_kwargs.learning_rate"] - BEST_RATE) + abs(0.9 - 0.98)
    assert best.score == pytest.approx(-4.5 * distance)
    recipe = yaml.safe_load(tuning.best_file.read_text())
    assert recipe["algo_kwargs"] == {
        **TINY["algo_kwargs"],
        "learning_rate": best.values["algo_kwargs.learning_rate"],
    }
    assert recipe.keys() == {"algo_kwargs", "n_envs"}  # neither how long nor how often evaluated
    shown = rlctl("tune", "--resume", "latest", "-o", tmp_path / "runs")  # nothing is left to train
    assert shown.returncode == 0
    assert f"best: trial {best.number}, in {tuning.best_file}" in shown.stdout
    assert shown.stdout.splitlines()[2].split()[0] == str(best.number)
    (unchanged,) = [line.split() for line in shown.stdout.splitlines() if line.endswith("recipe")]
    assert unchanged[:2] == ["0", "0.0003"]


@pytest.mark.slow
def test_too_few_evaluations_are_named(played, tmp_path, capsys):
    begin(tmp_path, RATES, trials=1, settings={"algo_kwargs": {"n_steps": 32, "batch_size": 32}})
    assert (
        "warning: a trial has only 2 evaluations: they happen between rollouts of 64 steps" in capsys.readouterr().err
    )
    begin(tmp_path / "longer", RATES, trials=1, settings={"total_timesteps": 1024})
    assert "warning" not in capsys.readouterr().err


def test_only_the_first_trial_checks_the_environment(played, tmp_path):
    begin(tmp_path, RATES, trials=2)
    assert [(call.check, call.settings["seed"]) for call in played.calls] == [(True, 0), (False, 1), (False, 2)]


@pytest.mark.slow
def test_a_step_keeps_what_the_one_before_found(played, tmp_path):
    tuning = begin(tmp_path, trials=4)
    by_step = {number: [each for each in tuning.trials if each.step == number] for number in range(4)}
    # Of two rollouts and two minibatches one pair is the recipe's own.
    assert [len(trials) for trials in by_step.values()] == [1, 4, 3, 4]
    first = max((each for each in by_step[1] if each.state == "done"), key=lambda each: each.score)
    if first.score > by_step[0][0].score:
        rate = first.values["algo_kwargs.learning_rate"]
        assert all(each.values["algo_kwargs.learning_rate"] == rate for each in by_step[2])
    assert all("algo_kwargs.gamma" in each.values for each in by_step[3])


@pytest.mark.slow
def test_no_choice_is_tried_twice(played, tmp_path):
    tuning = begin(tmp_path, "algo_kwargs.gamma=0.9,0.95,0.98", trials=20, settings={"algo_kwargs": {"gamma": 0.9}})
    assert tuning.trials[0].values == {}
    assert sorted(each.values["algo_kwargs.gamma"] for each in tuning.trials[1:]) == [0.95, 0.98]
    assert tuning.best.values == {"algo_kwargs.gamma": 0.98}


@pytest.mark.slow
def test_a_trial_that_falls_behind_is_stopped_and_its_checkpoints_go(played, tmp_path, capsys):
    tuning = begin(tmp_path, RATES, trials=12)
    pruned = [each for each in tuning.trials if each.state == "pruned"]
    assert pruned
    middle = sorted(each.score for each in tuning.trials if each.state == "done")
    assert all(each.score < middle[len(middle) // 2] for each in pruned)
    shown = capsys.readouterr().err
    assert f"trial {pruned[0].number}: stopped: below the median of the other trials" in shown
    assert "interrupted" not in shown
    assert not list(tuning.path.glob("*/checkpoints"))


@pytest.mark.slow
def test_a_trial_that_fails_stops_no_other(played, tmp_path, rlctl):
    played.fails = lambda settings: settings.get("algo_kwargs", {}).get("learning_rate", 0) > 1e-3
    tuning = begin(tmp_path, RATES, trials=8)
    failed = [each for each in tuning.trials if each.state == "failed"]
    assert failed
    assert {each.problem for each in failed} == {"it diverged"}
    assert len(tuning.trials) == 9
    shown = rlctl("tune", "--resume", tuning.path)
    assert shown.stdout.count("failed: it diverged") == len(failed)


def test_a_recipe_that_cannot_be_trained_is_not_tuned(played, tmp_path):
    played.fails = lambda settings: True
    with pytest.raises(TaskError, match="the unchanged recipe failed: it diverged"):
        begin(tmp_path, RATES)
    assert len(played.calls) == 1


def test_a_task_without_success_is_refused_at_its_first_evaluation(played, tmp_path, capsys):
    played.success = ""
    with pytest.raises(UsageError, match="--metric success: this task reports no success"):
        begin(tmp_path, RATES, metric="success")
    (evals,) = (tmp_path / "runs").rglob("evals.csv")
    assert len(evals.read_text().splitlines()) == 2
    assert "trial 0: stopped: no success\n" in capsys.readouterr().err


@pytest.mark.slow_except("1")
@pytest.mark.parametrize("interrupted_at", [1, 3])
def test_an_interrupted_tuning_goes_on(played, tmp_path, interrupted_at):
    played.interrupts_at = interrupted_at
    with pytest.raises(Interrupted, match="resume with: rlctl tune --resume"):
        begin(tmp_path, RATES, trials=4)
    assert len(played.calls) == interrupted_at
    (folder,) = (tmp_path / "runs").glob("*/*_tune")
    tuning = resume(folder, jobs=1)
    assert played.calls[interrupted_at].resume is not None
    assert [each.number for each in tuning.trials] == [0, 1, 2, 3, 4]
    assert {each.state for each in tuning.trials} <= {"done", "pruned"}
    again = resume(folder, jobs=1)
    assert len(played.calls) == 6
    assert again == tuning


@pytest.mark.slow
@pytest.mark.parametrize("killed_at", [1, 3])
def test_a_trial_that_was_killed_is_tried_again(played, tmp_path, killed_at):
    played.killed_at = killed_at
    if killed_at == 1:
        with pytest.raises(TaskError, match="the unchanged recipe failed: killed by SIGKILL"):
            begin(tmp_path, RATES, trials=4)
    else:
        begin(tmp_path, RATES, trials=4)
    (folder,) = (tmp_path / "runs").glob("*/*_tune")
    trial = load(folder).trials[killed_at - 1]
    assert (trial.state, trial.problem) == ("begun", "killed by SIGKILL")
    assert load(folder).find_run(trial).checkpoints()
    tuning = resume(folder, jobs=1)
    assert {each.state for each in tuning.trials} <= {"done", "pruned"}
    assert tuning.trials[killed_at - 1].problem == ""


def test_nothing_is_removed_in_a_run_that_another_process_holds(played, tmp_path):
    """The training is still running whose `rlctl tune` was killed."""
    played.interrupts_at = 2
    with pytest.raises(Interrupted):
        begin(tmp_path, RATES, trials=2)
    (folder,) = (tmp_path / "runs").glob("*/*_tune")
    run = load(folder).find_run(load(folder).trials[1])
    played.fails = lambda settings: True
    with run.lock():
        tuning = resume(folder, jobs=1)
    assert tuning.trials[1].state == "begun"
    assert "another process is writing this run" in tuning.trials[1].problem
    assert run.checkpoints()


@pytest.mark.slow
def test_tuners_share_a_storage_and_nothing_is_lost_on_resume(played, tmp_path):
    url = f"sqlite:///{tmp_path}/tune.db"
    one = begin(tmp_path, RATES, trials=3, storage=url)
    played.killed_at = len(played.calls) + 3
    other = begin(tmp_path, RATES, trials=3, storage=url)  # at another time, on another machine
    (study,) = optuna.get_all_study_summaries(url)
    assert study.study_name.startswith("Line algo_kwargs.learning_rate ")
    assert [trial.state for trial in other.trials].count("begun") == 1
    resumed = resume(other.path, jobs=1)
    assert {trial.state for trial in resumed.trials} <= {"done", "pruned"}
    trials = optuna.load_study(study_name=study.study_name, storage=url).get_trials()
    ended = [trial for trial in trials if trial.state != optuna.trial.TrialState.FAIL]
    labels = {f"{tuning.path.name}/{trial.number}" for tuning in (one, resumed) for trial in tuning.trials}
    assert sorted(trial.user_attrs["trial"] for trial in ended) == sorted(labels)


@pytest.mark.slow
def test_a_storage_that_cannot_be_opened(tmp_path):
    with pytest.raises(UsageError, match="--storage nothing://x: cannot be opened"):
        begin(tmp_path, RATES, storage="nothing://x")
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_several_at_a_time(played, tmp_path):
    tuning = begin(tmp_path, RATES, trials=8, jobs=4)
    assert sorted(each.number for each in tuning.trials) == list(range(9))
    assert len({json.dumps(each.values) for each in tuning.trials}) == 9


def test_its_runs_are_runs(played, tmp_path):
    tuning = begin(tmp_path, RATES, trials=2)
    root = tmp_path / "runs"
    listed = list_runs(root=root)
    assert len(listed) == 3
    assert {each.name.split("/")[1] for each in listed} == {tuning.path.name}
    assert plan_removal([str(tuning.path)], root=root).paths == [tuning.path.resolve()]
    with pytest.raises(UsageError, match="the trials of rlctl tune, not seeds of one recipe"):
        read_group(tuning.path)
    assert not (root / "latest").exists()
    with pytest.raises(UsageError, match="see its table: rlctl tune --resume"):
        find_run(str(tuning.path))
    with pytest.raises(ArtifactError, match=f"only trials of rlctl tune; name one of them, from {tuning.path}"):
        find_run(LINE, root)


@pytest.mark.parametrize(
    ("search", "error", "message"),
    [
        ("seed=0,1", UsageError, "--search seed: not a hyperparameter"),
        ("reward_weights.x=1,2", UsageError, "--search reward_weights.x: it changes the reward"),
        ("algo_kwargs.gama=0.9,0.99", RecipeError, "Did you mean 'gamma'?"),
        ("algo_kwargs.gamma=0.9:1.5", RecipeError, "gamma"),
    ],
)
def test_what_cannot_be_searched(search, error, message, tmp_path):
    with pytest.raises(error) as caught:
        begin(tmp_path, search)
    assert message in str(caught.value)
    assert not (tmp_path / "runs").exists()


def test_a_damaged_tuning(tmp_path):
    with pytest.raises(ArtifactError, match=r"not the folder of a tuning: it has no tune\.json"):
        resume(tmp_path)
    (tmp_path / "tune.json").write_text('{"task": 3}')
    with pytest.raises(ArtifactError, match="damaged"):
        resume(tmp_path)


SOUND = {"task": LINE, "config": None, "settings": {}, "metric": "return", "trials_per_step": 2, "seed": 0, "steps": []}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"task": "stranger.py:main"},
            r"tune\.json names 'stranger\.py:main' as its task, but stranger\.py does not",
        ),
        ({"storage": "sqlite:///new.db"}, r"new\.db, the database of its trials, does not exist"),
        ({"storage": "sqlite+pysqlite:///new.db?timeout=20"}, r": new\.db, the database of its trials, does not exist"),
        ({"storage": "new.db"}, "its storage 'new.db' is not the URL of a database"),
    ],
)
def test_a_tuning_of_somebody_else_runs_no_script_and_creates_no_database(tmp_path, monkeypatch, change, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stranger.py").write_text("open('ran', 'w')")
    (tmp_path / "tune.json").write_text(json.dumps({**SOUND, **change}))
    with pytest.raises(ArtifactError, match=message):
        resume(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"stranger.py", "tune.json"}


@pytest.mark.parametrize(
    "change",
    [
        {"trials_per_step": 10**30},
        {"trials": [{"number": 0, "step": 0, "values": {}, "state": "done", "score": float("nan")}]},
        {"trials": [{"number": 0, "step": 0, "values": {"algo_kwargs.gamma": float("nan")}}]},
        {"steps": [[{"key": "algo_kwargs.gamma", "low": 5.0, "high": -1.0}]]},
        {"trials": [{"number": 0, "step": 0, "values": {}}] * 2},
    ],
)
def test_a_tuning_with_impossible_numbers_is_damaged(tmp_path, change):
    (tmp_path / "tune.json").write_text(json.dumps(SOUND))
    assert load(tmp_path).trials_per_step == 2
    (tmp_path / "tune.json").write_text(json.dumps({**SOUND, **change}))
    with pytest.raises(ArtifactError, match="damaged"):
        load(tmp_path)


def test_without_optuna(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "optuna", None)
    with pytest.raises(UsageError, match=r"rlctl tune needs optuna: pip install 'rlctl\[tune\]'"):
        begin(tmp_path, RATES)


@pytest.mark.slow
def test_a_tuning_whose_process_was_killed_is_resumed(tmp_path, rlctl):
    """Its training ends with it, keeps its checkpoints, and is resumed."""
    options = ["-n", "20000", "--n-envs", "8", "--set", "eval.episodes=1", "--search", "algo_kwargs.gamma=0.5,0.99"]
    command = [sys.executable, "-m", "rlctl", "tune", LINE, *options, "--trials", "2", "--jobs", "1", "-o", tmp_path]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as parent:
        wait_for(lambda: list(tmp_path.glob("*/*_tune/*/checkpoints/0*/*")))
        parent.kill()
    (run,) = (RunDirectory(file.parent) for file in tmp_path.glob("*/*_tune/*/run.json"))
    wait_for(lambda: not is_being_written(run.path))
    assert run.checkpoints()
    assert run.status()["status"] != "finished"
    result = rlctl("tune", "--resume", run.path.parent, "--jobs", "1", "--json", "-")
    assert result.returncode == 0, result.stderr
    assert [trial["state"] for trial in json.loads(result.stdout)["trials"]] == ["done", "done"]
    assert run.status()["status"] == "finished"


def wait_for(condition, timeout_s=120.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_trainings_that_are_real(rlctl, tmp_path):
    settings = ["-n", "128", "--n-envs", "2", "--set", "algo_kwargs.n_steps=16", "--set", "eval.episodes=1"]
    search = ["--search", "algo_kwargs.gamma=0.5,0.99", "--trials", "2", "--jobs", "2"]
    result = rlctl("tune", LINE, *settings, *search, "--json", "-")
    assert result.returncode == 0, result.stderr
    content = json.loads(result.stdout)
    assert [(each["state"], each["values"]) for each in content["trials"]] == [
        ("done", {}),
        ("done", {"algo_kwargs.gamma": 0.5}),
    ]
    scores = [each["score"] for each in content["trials"]]
    assert content["best"] == scores.index(max(scores))
    episodes = sorted(tmp_path.glob("runs/Line/*_tune/*/episodes/000000.npz"))
    assert len({load_episode(file).info.seed for file in episodes}) == 1  # trials are compared in the same episodes
    assert len(episodes) == 2


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give a task to tune, or --resume FOLDER"),
        (("reach", "--metric", "score"), "Invalid value for '--metric'"),
        (("reach", "--search", "gamma"), "--search 'gamma': write KEY=LOW:HIGH"),
    ],
)
def test_mistakes(rlctl, arguments, message):
    result = rlctl("tune", *arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert message in result.stderr
