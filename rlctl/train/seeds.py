"""`rlctl train TASK --seeds 0-4`: an ordinary run for every seed, each in a process of its own, in one group."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import FrameType

from rlctl import output, registry
from rlctl.errors import Interrupted, RlctlError, UsageError
from rlctl.eval.evaluate import EvalRequest
from rlctl.eval.group import GroupScore, as_json, evaluate_group
from rlctl.rollout.child_process import LineReader, start_process
from rlctl.rollout.workers import available_cores
from rlctl.run import files
from rlctl.run.group import Group, create_group, parse_seeds, read_group
from rlctl.run.recipe_sources import resolve
from rlctl.train.request import TrainRequest
from rlctl.train.signals import HandledSignals
from rlctl.train.start import check_arguments, preserve_process_state
from rlctl.train.warm_start import find_source

CORES_PER_TRAINING = 2
"""One plays while the other learns, in turn or side by side."""


class SeedsFailed(RlctlError):
    """Some seeds of a group have failed; the exit code is the highest of theirs."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


@dataclasses.dataclass(frozen=True)
class SeedsResult:
    """How the trainings of a group ended."""

    score: GroupScore
    failed: Mapping[int, int]
    """Exit code per seed that failed."""

    def check(self) -> None:
        """Raise `SeedsFailed` if a seed failed."""
        if self.failed:
            which = ", ".join(f"seed {seed} with exit code {code}" for seed, code in self.failed.items())
            group = self.score.group
            raise SeedsFailed(
                f"{group.path}: {len(self.failed)} of {len(group.seeds)} seeds failed: {which}. "
                f"What each said is above; to try again: rlctl train --resume {shlex.quote(str(group.path))}",
                max(self.failed.values()),
            )


def train_seeds(
    request: TrainRequest, seeds: str | None, *, jobs: int | None = None, episodes: int = 100
) -> SeedsResult:
    """Train a request with several seeds, or go on with the group that it resumes; then evaluate each best policy.

    At most `jobs` train at a time. Seeds that are done are left as they are, and one that fails stops no other. Raises
    `UsageError` for seeds that are none, `RecipeError` for a recipe that is wrong, and `Interrupted` after a signal,
    when all have saved their checkpoints.
    """
    if seeds is not None:
        group, options = _begin(request, seeds), []
    else:
        check_arguments(request)
        group, options = read_group(Path(str(request.resume))), list_options(request)
    waiting = [seed for seed in group.seeds if not group.is_done(seed) or options]
    jobs = _choose_jobs(group, len(waiting), jobs)
    failed = _Trainings(jobs).run({seed: _make_command(group, seed, options) for seed in waiting}, group.path)
    score = evaluate_group(group, EvalRequest(None, episodes=episodes))
    files.write_json(group.scores_file, as_json(score))
    return SeedsResult(score, failed)


def _begin(request: TrainRequest, seeds: str) -> Group:
    """Make a new group, after a look at its task and recipe: what is wrong is wrong for every seed."""
    if request.task is None or request.resume is not None:
        raise UsageError("--seeds is about a new group: give a task, and no --resume")
    if "seed" in request.settings:
        raise UsageError("--seeds and --seed: give one of the two")
    check_arguments(request)
    numbers = parse_seeds(seeds)
    with preserve_process_state():
        registry.load(request.task)
    recipe = resolve(request.task, request.config, request.settings)
    if request.initial_policy is not None:
        find_source(request.initial_policy, recipe)
    return create_group(request.task, numbers, list_options(request), request.root)


def list_options(request: TrainRequest) -> list[str]:
    """Return the options of `rlctl train` that a request stands for, but for its task, seed and folder."""
    options = [f"--set={key}={json.dumps(value)}" for key, value in request.settings.items()]
    options += [f"--config={request.config}"] if request.config is not None else []
    options += [f"--from={request.initial_policy}"] if request.initial_policy is not None else []
    options += [f"--record={request.record}"] if request.record else []
    options += ["--force"] if request.force else []
    default = TrainRequest(None)
    for name, value, usual in (
        ("device", request.device, default.device),
        ("env-timeout", request.env_timeout_s, default.env_timeout_s),
    ):
        options += [f"--{name}={value}"] if value != usual else []
    return options if request.check else [*options, "--no-check"]


def _choose_jobs(group: Group, waiting: int, jobs: int | None) -> int:
    cores = available_cores()
    chosen = min(jobs or max(1, cores // CORES_PER_TRAINING), max(waiting, 1))
    done = len(group.seeds) - waiting
    note = f"{group.path}: {output.format_count(len(group.seeds), 'seed')}"
    if waiting:
        note += (
            f"{f', {done} done' if done else ''}, {chosen} at a time: a training keeps {CORES_PER_TRAINING} cores "
            f"busy, there are {cores}; --jobs changes it"
        )
    else:
        note += ", all done: nothing to train; -n makes them longer"
    output.print_notes([note])
    return chosen


def _make_command(group: Group, seed: int, options: Sequence[str]) -> list[str]:
    run = group.find_run(seed)
    if run is not None:
        return ["train", "--resume", str(run.path), *options]
    return ["train", group.task, "--seed", str(seed), "--output", str(group.path), *group.options, *options]


class _Trainings:
    """Processes that train a seed each, some of them at a time, and each of these with its share of the cores."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._places = itertools.count()
        self._running: set[int] = set()  # by process id
        self._stopped_by: int | None = None

    def run(self, commands: Mapping[int, list[str]], group: Path) -> dict[int, int]:
        """Train all; return the exit code of each seed that failed. Raises `Interrupted` after a signal."""
        with HandledSignals(self._pass_on), ThreadPoolExecutor(self._jobs, initializer=self._take_cores) as pool:
            codes = list(pool.map(self._train, commands, commands.values()))
        if self._stopped_by is not None:
            raise Interrupted(
                f"interrupted; go on with: rlctl train --resume {shlex.quote(str(group))}", self._stopped_by
            )
        return {seed: code for seed, code in zip(commands, codes, strict=True) if code}

    def _take_cores(self) -> None:
        """Let what this thread starts use its share of the cores, from which it also takes its number of workers."""
        place = next(self._places)
        if self._jobs > 1 and hasattr(os, "sched_setaffinity"):
            cores = sorted(os.sched_getaffinity(0))
            share = max(1, len(cores) // self._jobs)
            first = place * share % len(cores)
            os.sched_setaffinity(0, cores[first : first + share])

    def _train(self, seed: int, arguments: Sequence[str]) -> int:
        """Train a seed; return its exit code."""
        if self._stopped_by is not None:
            return 0
        reader = LineReader(functools.partial(_print_line, seed))
        process = start_process(
            [sys.executable, "-m", "rlctl", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=reader.descriptor,
            process_group=0,  # which a terminal's Ctrl-C does not reach: signals are passed on, once each
        )
        self._running.add(process.pid)
        reader.close_descriptor()
        if self._stopped_by is not None:  # meanwhile
            os.kill(process.pid, self._stopped_by)
        code = process.wait()
        self._running.discard(process.pid)
        reader.wait()
        return code if code >= 0 else 128 - code

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self._stopped_by = self._stopped_by or number
        for process in list(self._running):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, number)


def _print_line(seed: int, line: str) -> None:
    print(f"seed {seed}: {line}", file=sys.stderr, flush=True)
