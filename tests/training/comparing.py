"""What two runs that should be the same are compared by: everything but time."""

import csv
import dataclasses

import numpy as np
from safetensors.numpy import load_file

from rlctl.runs.directory import RunDirectory
from rlctl.training import checkpoint_file

OF_TIME = ("seconds", "fps", "playing", "acting")


class Killed(BaseException):
    """Ends a training where it is, as nothing that can be handled does."""


def rows(file):
    with file.open() as table:
        return [{key: value for key, value in row.items() if key not in OF_TIME} for row in csv.DictReader(table)]


def replay_buffer(run: RunDirectory, segments) -> dict:
    """Return the transitions by number, as they are after all segments."""
    transitions = {}
    for segment in segments:
        arrays = load_file(run.replay_parts / segment.name)
        for place, number in enumerate(range(segment.first, segment.last)):
            transitions[number] = {name: array[place] for name, array in arrays.items()}
    return transitions


def assert_same_run(one: RunDirectory, other: RunDirectory) -> None:
    """Compare tables, the newest checkpoints bit by bit, and what was evaluated."""
    assert rows(one.metrics_file) == rows(other.metrics_file)
    assert rows(one.evals_file) == rows(other.evals_file)
    (ours, _), (theirs, _) = checkpoint_file.read_newest(one), checkpoint_file.read_newest(other)
    assert ours.state.step == theirs.state.step
    assert ours.tensors.keys() == theirs.tensors.keys()
    different = [name for name, values in ours.tensors.items() if values.tobytes() != theirs.tensors[name].tobytes()]
    assert different == []
    assert repr(ours.state.model) == repr(theirs.state.model)
    timeless = {"seconds": 0.0, "metrics_bytes": 0, "evals_bytes": 0, "metrics_sha256": "", "evals_sha256": ""}
    assert dataclasses.replace(ours.state.progress, **timeless) == dataclasses.replace(
        theirs.state.progress, **timeless
    )
    _assert_same_transitions(replay_buffer(one, ours.state.segments), replay_buffer(other, theirs.state.segments))
    assert load_best(one).keys() == load_best(other).keys()
    for name, values in load_best(one).items():
        np.testing.assert_array_equal(values, load_best(other)[name])


def _assert_same_transitions(ours, theirs):
    # The oldest ones may still be there in a segment of one run and be gone with it in the other.
    first = max(min(ours, default=0), min(theirs, default=0))
    assert max(ours, default=0) == max(theirs, default=0)
    for number in range(first, max(ours, default=-1) + 1):
        for name, values in ours[number].items():
            np.testing.assert_array_equal(values, theirs[number][name], err_msg=f"transition {number}, {name}")


def load_best(run: RunDirectory) -> dict:
    return load_file(run.best_policy)
