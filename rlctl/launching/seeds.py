"""`rlctl train TASK --seeds 0-4`: a group with an ordinary run for every seed, each in its own process."""

import dataclasses
import functools
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rlctl import output
from rlctl.environments import named_task
from rlctl.errors import RlctlError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.group_scores import GroupScore, evaluate_group
from rlctl.launching.trainings import MakeTrainings, make_local_trainings
from rlctl.runs.directory import RunLock
from rlctl.runs.group import Group, create_group, parse_seeds, read_group
from rlctl.runs.train_request import TrainRequest
from rlctl.storage import files
from rlctl.training.start import check_arguments, find_start


class SeedsFailed(RlctlError):
    """Some seeds of a group failed; the exit code is the highest of their exit codes."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


@dataclasses.dataclass(frozen=True)
class SeedsResult:
    """How the trainings of a group ended."""

    score: GroupScore
    failed: Mapping[int, int]  # exit code per seed that failed

    def check(self) -> None:
        """Raise `SeedsFailed` if a seed failed."""
        if self.failed:
            which = ", ".join(f"seed {seed} with exit code {code}" for seed, code in self.failed.items())
            group = self.score.group
            raise SeedsFailed(
                f"{group.path}: {len(self.failed)} of {len(group.seeds)} seeds failed: {which}. "
                f"Their output is above; to retry: rlctl train --resume {shlex.quote(str(group.path))}",
                max(self.failed.values()),
            )


def train_seeds(
    request: TrainRequest,
    seeds: str | None,
    *,
    jobs: int | None = None,
    episodes: int = 100,
    make_trainings: MakeTrainings = make_local_trainings,
) -> SeedsResult:
    """Train a request with several seeds, or resume its group; then evaluate the best policy of each seed.

    At most `jobs` train at a time; `make_trainings` decides where. Finished seeds are not trained again, and a seed
    that fails does not stop the others. Raises `Interrupted` after a signal, when all have saved their checkpoints.
    """
    if seeds is not None:
        group, resume = _begin(request, seeds), TrainRequest()
    else:
        check_arguments(request)
        group, resume = read_group(Path(str(request.resume))), request
        named_task.check_source(group.task, named_task.GROUP)
    with RunLock(group.path, "group"):
        return _train(group, resume, jobs, episodes, make_trainings)


def _train(
    group: Group, resume: TrainRequest, jobs: int | None, episodes: int, make_trainings: MakeTrainings
) -> SeedsResult:
    has_changes = resume != TrainRequest(resume=resume.resume, root=resume.root)
    waiting = [seed for seed in group.seeds if has_changes or not group.is_done(seed)]
    requests = {seed: _make_request(group, seed, resume) for seed in waiting}
    trainings = make_trainings(group.path, str(group.request.task), len(requests), jobs)
    done = f"{len(group.seeds) - len(waiting)} done, " if len(waiting) < len(group.seeds) else ""
    state = f"{done}{trainings.describe()}" if waiting else "all done: nothing to train; to train longer, give -n"
    output.print_notes([f"{group.path}: {_describe(group.seeds)}, {state}"])
    calls = [
        functools.partial(trainings.train, request_of_seed, functools.partial(_print_line, seed))
        for seed, request_of_seed in requests.items()
    ]
    codes = trainings.run(calls, f"rlctl train --resume {shlex.quote(str(group.path))}")
    failed = {seed: code for seed, code in zip(requests, codes, strict=True) if code}
    score = evaluate_group(group, EvalRequest(None, episodes=episodes))
    files.write_json(group.scores_file, score.as_json())
    return SeedsResult(score, failed)


def _describe(seeds: Sequence[int]) -> str:
    """Return `seed 4` or `5 seeds (0 to 4)`; `3 seeds (0, 3, 7)`."""
    if len(seeds) == 1:
        return f"seed {seeds[0]}"
    is_range = list(seeds) == list(range(seeds[0], seeds[-1] + 1)) and len(seeds) > 2
    numbers = f"{seeds[0]} to {seeds[-1]}" if is_range else ", ".join(map(str, seeds))
    return f"{len(seeds)} seeds ({numbers})"


def _begin(request: TrainRequest, seeds: str) -> Group:
    if request.task is None or request.resume is not None:
        raise UsageError("--seeds starts a new group: give TASK and leave out --resume")
    if "seed" in request.settings:
        raise UsageError("--seeds and --seed exclude each other")
    numbers = parse_seeds(seeds)
    if len(numbers) == 1 and (seed := numbers[0]) > 1:
        several = f"for {seed} seeds: --seeds 0-{seed - 1}"
        output.print_notes([f"--seeds {seeds}: one run, with seed {seed}; {several}"])
    find_start(request)
    return create_group(request, numbers)


def _make_request(group: Group, seed: int, resume: TrainRequest) -> TrainRequest:
    """Return a seed's request: the group's, with the changes of `resume`; a run that exists is resumed."""
    default = TrainRequest()
    changes = {name: value for name, value in vars(resume).items() if value != getattr(default, name)}
    request = dataclasses.replace(group.request, **{**changes, "root": group.path})
    run = group.find_run(seed)
    if run is None:
        settings = {**group.request.settings, **resume.settings, "seed": seed}
        return dataclasses.replace(request, resume=None, settings=settings)
    return request.to_resume(run.path, resume.settings)


def _print_line(seed: int, line: str) -> None:
    print(f"seed {seed}: {line}", file=sys.stderr, flush=True)
