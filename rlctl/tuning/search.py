"""A step of a tuning: Optuna proposes values, trainings try them; trainings below the median are stopped."""

import contextlib
import dataclasses
import json
import math
import signal
import sys
import threading
from typing import Any

import optuna
from optuna.trial import TrialState

from rlctl.environments import registry
from rlctl.environments.spec import merge
from rlctl.errors import RunTaken, UsageError
from rlctl.launching.trainings import Trainings
from rlctl.runs.directory import RunDirectory
from rlctl.runs.train_request import TrainRequest
from rlctl.storage import files
from rlctl.tuning.space import get_value, nest
from rlctl.tuning.tuning import Trial, Tuning, find_best

_RANDOM_SHARE = 3  # a third of a step's trials are random: the sampler learns from them
_EVALUATIONS_BEFORE_PRUNING = 2
_TRIALS_BEFORE_PRUNING = 3
_MOST_REPEATS = 50
_KILLED = 128 + signal.SIGKILL
_LABEL = "trial"  # user attribute of Optuna's trials: tuning and number of the trial
_STATES = {"done": TrialState.COMPLETE, "pruned": TrialState.PRUNED, "failed": TrialState.FAIL}

optuna.logging.set_verbosity(optuna.logging.WARNING)


class StepSearch:
    """Searches the dimensions of one step, with the best values of earlier steps. `run_next` is thread-safe."""

    def __init__(self, tuning: Tuning, number: int, recipe: dict[str, Any], trainings: Trainings) -> None:
        """Begin or resume step `number`, from 1. `recipe` is the task's, with defaults, as plain data."""
        self._tuning, self._number, self._trainings = tuning, number, trainings
        self._dimensions = tuning.steps[number - 1]
        self._distributions = {dimension.key: dimension.make_distribution() for dimension in self._dimensions}
        best = find_best([trial for trial in tuning.trials if trial.step < number])
        assert best is not None  # at least the unchanged recipe
        self._recipe, self._best_values = recipe, best.values
        self._study = self._open_study()
        self._lock = threading.Lock()
        own = [trial for trial in tuning.trials if trial.step == number]
        self._begun = [trial for trial in own if trial.state == "begun"]
        self._finished = [trial for trial in own if trial.state != "begun"]
        for trial in (best, *self._finished):  # the best trial so far also has values of these dimensions
            self._add(trial)

    def _open_study(self) -> optuna.Study:
        """Return Optuna's study; with a storage, tuners with an equal search share it."""
        tuning = self._tuning
        random_trials = max(2, tuning.trials_per_step // _RANDOM_SHARE)
        # Tuners that share a study must not propose equal values.
        seed = None if tuning.storage else tuning.seed + self._number
        study = optuna.create_study(
            storage=tuning.storage,
            study_name=self._name_study() if tuning.storage else None,
            load_if_exists=True,
            direction="maximize",
            sampler=optuna.samplers.TPESampler(seed=seed, n_startup_trials=random_trials),
            pruner=optuna.pruners.MedianPruner(0, _EVALUATIONS_BEFORE_PRUNING, n_min_trials=_TRIALS_BEFORE_PRUNING),
        )
        for asked in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            if str(asked.user_attrs.get(_LABEL, "")).startswith(f"{tuning.path.name}/"):  # its tuner was stopped
                study.tell(asked.number, state=TrialState.FAIL)
        return study

    def _name_study(self) -> str:
        """Return a name that only tuners with comparable scores share."""
        tuning = self._tuning
        settings = {key: value for key, value in tuning.settings.items() if key != "seed"}
        search = [dataclasses.asdict(dimension) for dimension in self._dimensions]
        content = [tuning.task, str(tuning.config), settings, tuning.metric, search, self._best_values]
        digest = files.digest(json.dumps(content, sort_keys=True).encode())
        return f"{registry.make_slug(tuning.task)} {', '.join(self._distributions)} {digest[:8]}"

    def count_waiting(self) -> int:
        """Return the number of trials to train, including unfinished ones; ask before the first begins."""
        sizes = [len(dimension.choices) or math.inf for dimension in self._dimensions]
        # The unchanged recipe, already trained, is the first trial of the first step.
        trials = self._tuning.trials_per_step - (self._number == 1)
        most = min(trials, math.prod(sizes) - 1)  # the best trial already has one combination
        return max(0, int(most) - len(self._finished))

    def run_next(self) -> None:
        """Train the next trial, and store its result."""
        if self._trainings.stopped_by is not None:
            return
        with self._lock:
            proposal = self._propose()
        if proposal is not None:
            trial, asked = proposal
            train(self._tuning, trial, self._trainings, _Pruning(self._tuning, trial, asked))
            with self._lock:
                if trial.state != "begun" and asked is None:
                    self._add(trial)
                elif trial.state != "begun" and asked is not None:
                    self._study.tell(asked, trial.score if trial.state == "done" else None, _STATES[trial.state])
                self._tuning.save()

    def _propose(self) -> tuple[Trial, optuna.Trial | None] | None:
        """Return a trial and Optuna's (None for a resumed trial); None if all proposals were tried before."""
        if self._begun:
            return self._begun.pop(0), None
        for _ in range(_MOST_REPEATS):
            asked = self._study.ask(self._distributions)
            drawn = {dimension.key: dimension.to_value(asked.params[dimension.key]) for dimension in self._dimensions}
            values = {**self._best_values, **drawn}
            values = {key: value for key, value in values.items() if value != get_value(self._recipe, key)}
            known = next((trial for trial in self._tuning.trials if trial.values == values), None)
            if known is None:
                trial = Trial(len(self._tuning.trials), self._number, values)
                self._tuning.trials.append(trial)
                self._tuning.save()
                asked.set_user_attr(_LABEL, self._label(trial))
                return trial, asked
            # Do not train equal values twice: report the first result to Optuna.
            state = _STATES.get(known.state, TrialState.FAIL)
            self._study.tell(asked, known.score if state == TrialState.COMPLETE else None, state)
        return None

    def _label(self, trial: Trial) -> str:
        return f"{self._tuning.path.name}/{trial.number}"

    def _add(self, trial: Trial) -> None:
        """Add a finished trial to Optuna's study if its values are within the distributions."""
        content, state = merge(self._recipe, nest(trial.values)), _STATES[trial.state]
        values = ((dimension, get_value(content, dimension.key)) for dimension in self._dimensions)
        drawn = {dimension.key: dimension.from_value(value) for dimension, value in values}
        known = (asked.user_attrs.get(_LABEL) for asked in self._study.get_trials(deepcopy=False, states=(state,)))
        if None in drawn.values() or self._label(trial) in known:
            return
        finished = optuna.trial.create_trial(
            state=state,
            value=trial.score if state == TrialState.COMPLETE else None,
            params=drawn,
            distributions=self._distributions,
            user_attrs={_LABEL: self._label(trial)},
            intermediate_values=dict(enumerate(self._tuning.list_scores(trial))),
        )
        self._study.add_trial(finished)


class _Pruning:
    """Decides while a trial trains whether to stop it; a resumed one, without `asked`, is never stopped."""

    def __init__(self, tuning: Tuning, trial: Trial, asked: optuna.Trial | None) -> None:
        self._tuning, self._trial, self._asked = tuning, trial, asked
        self._reported, self.decided = 0, False

    def is_hopeless(self) -> bool:
        """Report the evaluations since the last call; return whether to stop the trial."""
        if self._asked is not None:
            for score in self._tuning.list_scores(self._trial)[self._reported :]:
                self._asked.report(score, self._reported)
                self._reported += 1
                self.decided = self.decided or self._asked.should_prune()
        return self.decided


def train(tuning: Tuning, trial: Trial, trainings: Trainings, pruning: _Pruning | None = None) -> None:
    """Train or resume a trial, and store how it ended; without `pruning` an evaluation must have the metric."""
    lines: list[str] = []

    def lacks_metric() -> bool:
        return bool(tuning.list_scores(trial, "return")) and not tuning.list_scores(trial)

    def receive(line: str) -> None:
        lines.append(line)
        if line.startswith("error: interrupted"):
            reason = "stopped: below the median of the other trials" if pruning else f"stopped: no {tuning.metric}"
            line = reason if trainings.stopped_by is None else "interrupted"
        print(f"trial {trial.number}: {line}", file=sys.stderr, flush=True)

    changes = [f"{key.rpartition('.')[2]}={value}" for key, value in trial.values.items()]
    print(f"trial {trial.number}: {', '.join(changes) or 'the unchanged recipe'}", file=sys.stderr, flush=True)
    code = trainings.train(_make_request(tuning, trial), receive, pruning.is_hopeless if pruning else lacks_metric)
    if pruning is None and lacks_metric():
        raise UsageError(f"--metric {tuning.metric}: this task reports no success (no is_success); use --metric return")
    run = tuning.find_run(trial)
    if trainings.stopped_by is not None and not (code == 0 and _has_finished(run)):
        return
    try:
        lock = contextlib.nullcontext() if run is None else run.lock()
    except RunTaken as error:
        trial.problem = str(error)
        return
    with lock:
        if code in (_KILLED, RunTaken.exit_code):  # the result is unknown: `tune --resume` trains it again
            trial.problem = "killed by SIGKILL" if code == _KILLED else "another process trained it"
            return
        _note_end(tuning, trial, run, code, lines, pruned=pruning is not None and pruning.decided)
        if run is not None:  # nobody resumes these trainings, and their replay buffers are large; the policies stay
            files.remove_tree(run.checkpoint(0).parent)


def _has_finished(run: RunDirectory | None) -> bool:
    return run is not None and run.status().get("status") == "finished"


def _note_end(
    tuning: Tuning, trial: Trial, run: RunDirectory | None, code: int, lines: list[str], *, pruned: bool
) -> None:
    trial.problem = ""
    if code == 0 and _has_finished(run):
        trial.state, trial.score = "done", tuning.measure(trial)
        if trial.score is None:
            trial.state, trial.problem = "failed", f"no evaluation reported {tuning.metric}"
    elif pruned:
        trial.state, trial.score = "pruned", tuning.measure(trial)
    else:
        errors = [line for line in lines if line.startswith("error: ")] or [f"error: exit code {code}", *lines[-1:]]
        trial.state, trial.problem = "failed", errors[0].removeprefix("error: ")


def _make_request(tuning: Tuning, trial: Trial) -> TrainRequest:
    run = tuning.find_run(trial)
    if run is not None and run.checkpoints():
        return TrainRequest(resume=str(run.path), check=trial.number == 0)
    return TrainRequest(
        tuning.task,
        config=tuning.config,
        settings=merge(tuning.settings, nest(trial.values)) | {"seed": tuning.seed + trial.number},
        check=trial.number == 0,  # the first trial has checked the environment
        root=tuning.path,
    )
