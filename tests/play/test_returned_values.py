"""What a worker says of what environments do and return: here in this process, without one."""

import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.play.messages import (
    Attach,
    Build,
    FailedInEpisode,
    LoadPolicy,
    Play,
    WorkerJob,
    describe_failure,
    format_hint,
)
from rlctl.play.worker import Worker
from rlctl.processes.child_process import anonymous_file
from rlctl.processes.pool import WorkerException
from tests.training import faulty_envs

ENVS = faulty_envs.__file__


def failure(env, **parameters):
    """Return what a worker reports of the episode of seed 7."""
    worker = Worker(WorkerJob(anonymous_file(), -1, 0, 1, 1))
    worker.answer(Build(EnvSpec(f"{ENVS}:{env}", parameters)))
    worker.answer(Attach(10))
    worker.answer(LoadPolicy(other="zero"))
    with pytest.raises(FailedInEpisode) as caught:
        worker.answer(Play(10, {0: 7}))
    return describe_failure(caught.value)


@pytest.mark.slow_except(first=5)
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("nan reward", "reward is nan"),
        ("inf reward", "reward is inf"),
        ("no reward", "reward is None, not a number"),
        ("text reward", "reward is '1.0', not a number"),
        ("two rewards", "reward is array([1., 1.]), not a number"),
        ("nan observation", "observation is not finite: element 0 is nan"),
        ("shape", "observation has shape (2,), the space has (1,)"),
        ("no observation", "observation has shape (), the space has (1,)"),
        ("objects", "observation is [{}], not numbers"),
        (
            "nothing",
            "step returned None; Gymnasium requires (observation, reward, terminated, truncated, info)",
        ),
        (
            "old gym",
            "step returned 4 values; Gymnasium requires (observation, reward, terminated, truncated, info)",
        ),
        ("no info", "info is None, not a dict"),
        ("text flag", "terminated is 'False', not a bool"),
        ("text term", "info['reward_terms'] is {'speed': 'fast'}, not a dict of numbers"),
        ("term list", "info['reward_terms'] is [1.0], not a dict of numbers"),
        ("text success", "info['is_success'] is 'yes', not a bool"),
        ("nan success", "info['is_success'] is nan, not a bool"),
    ],
)
def test_what_is_returned(fault, message):
    assert failure("Faulty", fault=fault) == WorkerException(f"ValueError: {message}", where=(0, 7, 7))


@pytest.mark.slow_except(first=5)
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raise", "RuntimeError: the gripper fell off"),
        ("unprintable", "Unprintable: (message unavailable: ZeroDivisionError)"),
        ("local class", "Local: nobody can import this"),
        ("file name", r"ValueError: cannot open caf\udce9.stl"),
        ("long text", f"RuntimeError: one line and another {'x' * 379}..."),
        ("interrupt", "KeyboardInterrupt"),
        ("exit", "SystemExit: 0"),
        ("generator exit", "GeneratorExit"),
        ("recursion", "RecursionError: maximum recursion depth exceeded"),
        ("memory", "MemoryError"),
    ],
)
@pytest.mark.parametrize("at_reset", [False, True])
def test_what_is_raised(fault, message, at_reset):
    found = failure("Faulty", fault=fault, at_reset=at_reset)
    assert found.message == message
    assert found.where == (0, 7, 0 if at_reset else 7)
    assert found.details.splitlines()[1].startswith(f'  File "{ENVS}"')
    assert "/rlctl/play/" not in found.details


def test_a_path_with_spaces_can_be_typed_as_it_is_shown():
    assert format_hint("my envs/a.py:A") == "to see it alone: rlctl check-env 'my envs/a.py:A'"


def test_a_category_that_the_space_has_not():
    assert failure("Category").message == "ValueError: observation is 3, the space has 0 to 2"


def test_functions_that_call_each_other_for_ever():
    from rlctl.errors import format_plugin_traceback

    def one():
        other()

    def other():
        one()

    with pytest.raises(RecursionError) as caught:
        one()
    lines = format_plugin_traceback(caught.value).splitlines()
    assert len(lines) == 82  # a header, two lines per frame, the exception
