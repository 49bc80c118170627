"""What it costs that a training can go on after anything."""

from __future__ import annotations

import contextlib
import pickle
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.benchmarks.row import Row

_SHARE, _BESIDE = 0.02, 0.12
_TRANSITIONS, _SIZE, _NEW = 300_000, 53, 1_000


def while_ppo_trains(repeat: int) -> Row:
    """Measure the part of a training of `reach` that checkpoints take, evaluations left out."""
    return _while_training("checkpoints, PPO", {"total_timesteps": 60_000}, repeat)


def while_sac_trains(repeat: int) -> Row:
    """Do the same for SAC, whose replay buffer grows."""
    settings = {"algo": "sac", "total_timesteps": 6_000, "algo_kwargs": {"learning_starts": 500}}
    return _while_training("checkpoints, SAC", settings, repeat)


def beside_training(repeat: int) -> Row:
    """Measure the part of a training of `reach`, as shipped, that is neither playing nor learning.

    It is the time in `TrainingLoop.boundary`, where checkpoints, logging and evaluations are, of that in
    `TrainingLoop.run`: from the first step to the end, without the start of the program and its processes.
    """
    found = [_train_as_shipped(seed) for seed in range(repeat)]
    share, evaluations, checkpoints, seconds = (statistics.median(column) for column in zip(*found, strict=True))
    return Row(
        "checkpoints, logging, evaluation",
        f"{share:.1%}",
        "-",
        f"{share / _BESIDE:.2f} of what they may",
        "<= 12 % of the time",
        share <= _BESIDE,
        f"reach as shipped, {seconds:.1f} s: evaluations {evaluations:.1%}, checkpoints {checkpoints:.1%}, "
        f"logging and the rest {share - evaluations - checkpoints:.1%}",
    )


def _train_as_shipped(seed: int) -> tuple[float, float, float, float]:
    """Return the parts of the time at boundaries, in evaluations and in checkpoints, and the time [s]."""
    from rlctl.training.checkpoints import Checkpoints
    from rlctl.training.loop import TrainingLoop

    with (
        _timed_calls(TrainingLoop, "boundary") as boundaries,
        _timed_calls(TrainingLoop, "evaluate") as evaluations,
        _timed_calls(Checkpoints, "save") as checkpoints,
        _timed_calls(TrainingLoop, "run") as runs,
    ):
        _run({"seed": seed})
    seconds = _total(runs)
    return _total(boundaries) / seconds, _total(evaluations) / seconds, _total(checkpoints) / seconds, seconds


def _while_training(name: str, settings: dict, repeat: int) -> Row:
    found = [_train({**settings, "seed": seed}) for seed in range(repeat)]
    share, count, first, second, milliseconds = (statistics.median(column) for column in zip(*found, strict=True))
    return Row(
        name,
        f"{share:.2%}",
        "-",
        f"{share / _SHARE:.2f} of what it may",
        "<= 2 % of the time, the first within 3 s",
        share <= _SHARE and first <= 3.0,
        f"{count:.0f} checkpoints, {milliseconds:.1f} ms in the median; "
        f"the first {first:.2f} s and the second {second:.2f} s after training began",
    )


def _train(settings: dict) -> tuple[float, int, float, float, float]:
    """Return the part of the time, how many, when the first two were there [s], and the median of their times [ms]."""
    from rlctl.training.checkpoints import Checkpoints
    from rlctl.training.loop import TrainingLoop

    with (
        _timed_calls(Checkpoints, "save") as saves,
        _timed_calls(TrainingLoop, "evaluate") as evaluations,
        _timed_calls(TrainingLoop, "run") as runs,
    ):
        _run(settings)
    began = runs[0][0]
    trained = saves[-1][1] - began - _total(evaluations)
    first, second = (end - began for _, end in saves[:2])
    return _total(saves) / trained, len(saves), first, second, 1000 * statistics.median(b - a for a, b in saves)


def _run(settings: dict) -> None:
    from rlctl.launching.train import run_training
    from rlctl.runs.train_request import TrainRequest

    with tempfile.TemporaryDirectory() as folder:
        run_training(TrainRequest("reach", settings=settings, root=Path(folder), check=False))


@contextlib.contextmanager
def _timed_calls(owner: type, method: str) -> Iterator[list[tuple[float, float]]]:
    """Note when each call of a method began and ended [s]."""
    calls: list[tuple[float, float]] = []
    original = getattr(owner, method)

    def timed(*arguments, **options):
        began = time.monotonic()
        try:
            return original(*arguments, **options)
        finally:
            calls.append((began, time.monotonic()))

    setattr(owner, method, timed)
    try:
        yield calls
    finally:
        setattr(owner, method, original)


def _total(calls: list[tuple[float, float]]) -> float:
    return sum(end - began for began, end in calls)


def replay_buffer(repeat: int) -> Row:
    """Save what is new in a replay buffer of 300,000 transitions of 53 numbers, against pickling it as SB3 does."""
    ours, theirs, restored = (
        statistics.median(column) for column in zip(*(_saved() for _ in range(repeat)), strict=True)
    )
    return Row(
        "replay buffer",
        f"{1000 * ours:.1f} ms",
        f"{1000 * theirs:.0f} ms",
        f"{theirs / ours:.0f}x",
        ">= 10x",
        theirs / ours >= 10,
        f"{_TRANSITIONS:,} x {_SIZE}, {_NEW:,} new ones a save, with fsync and sha256; restored in {restored:.2f} s; "
        "against pickle as SB3's save_replay_buffer",
    )


def _saved() -> tuple[float, float, float]:
    """Return how long a save of new transitions takes, one of all by pickle, and reading all again [s]."""
    from gymnasium import spaces
    from stable_baselines3.common.buffers import ReplayBuffer

    from rlctl.training.checkpoint_file import ReplayParts

    box = spaces.Box(-1, 1, (_SIZE,), np.float32)
    buffer = ReplayBuffer(_TRANSITIONS, box, spaces.Box(-1, 1, (8,), np.float32))
    rng = np.random.default_rng(0)
    for values in (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards):
        values[...] = rng.random(values.shape, np.float32)
    last = _TRANSITIONS + 10 * _NEW
    with tempfile.TemporaryDirectory() as folder:
        parts = ReplayParts(Path(folder), buffer)
        parts.save(_TRANSITIONS)
        saves = [_timed(parts.save, added) for added in range(_TRANSITIONS + _NEW, last, _NEW)]
        named = parts.save(last)
        pickled = _timed(_pickle, buffer, Path(folder) / "buffer.pkl")
        return statistics.median(saves), pickled, _timed(parts.load, named, last)


def _pickle(buffer, file: Path) -> None:
    with file.open("wb") as stream:
        pickle.dump(buffer, stream)


def _timed(call, *arguments) -> float:
    began = time.monotonic()
    call(*arguments)
    return time.monotonic() - began
