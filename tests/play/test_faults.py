"""Environments that go wrong: the message names task, environment, seed and step, and nothing is left running."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import psutil
import pytest

from rlctl.errors import TaskError
from rlctl.play.messages import Play
from tests.play.conftest import ENVS

pytestmark = pytest.mark.usefixtures("no_child_left")


def play(workers, steps=4):
    """Play episodes from seed 5 on: environment 2 plays the faulty seed."""
    workers.set_other_policy("zero")
    workers.start_playing(Play(steps, {env: env + 5 for env in range(workers.n_envs)}))
    workers.finish_playing()


PLACE = f"in environment 2, episode seed 7, step 3; to see it alone: rlctl check-env {ENVS}:Walk"


@pytest.mark.slow_except(first=3)
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raise", "RuntimeError: the gripper fell off"),
        ("nan observation", "ValueError: observation is not finite: element 0 is nan"),
        ("inf reward", "ValueError: reward is inf"),
        ("shape", "ValueError: observation has shape (5,), the space has (2,)"),
        ("exit", "SystemExit: done here"),
        ("segfault", "worker 1 was killed by SIGSEGV while stepping"),
        ("_exit", "worker 1 ended with exit code 4 while stepping"),
    ],
)
def test_a_step_that_fails(spec, start, fault, message):
    workers = start(spec("Walk", fault=fault), 4, n_workers=2)
    with pytest.raises(TaskError) as caught:
        play(workers)
    assert str(caught.value) == f"task '{ENVS}:Walk': {message}\n{PLACE}"
    assert caught.value.exit_code == 3


def test_the_environments_own_traceback_comes_along(spec, start):
    workers = start(spec("Walk", fault="raise"), 4, n_workers=1)
    with pytest.raises(TaskError) as caught:
        play(workers)
    assert 'raise RuntimeError("the gripper fell off")' in caught.value.details
    assert "in fail" in caught.value.details


def test_a_hang_is_ended(spec, start):
    workers = start(spec("Walk", fault="hang"), 4, n_workers=2)
    workers.reset({0: 0})
    workers.timeout_s = 1.0  # from here on a step in environment 2 is all that takes long
    with pytest.raises(TaskError) as caught:
        play(workers)
    assert str(caught.value) == (
        f"task '{ENVS}:Walk': no answer for 1 s while stepping; if that may take so long, raise --env-timeout\n{PLACE}"
    )


def test_a_worker_that_is_killed_while_idle(spec, start, children):
    workers = start(spec("Walk"), 4, n_workers=2)
    workers.reset({env: env for env in range(4)})
    _, victim = children()
    victim.kill()
    os.waitid(os.P_PID, victim.pid, os.WEXITED | os.WNOWAIT)
    with pytest.raises(TaskError) as caught:
        play(workers)
    assert str(caught.value).startswith(f"task '{ENVS}:Walk': worker 1 was killed by SIGKILL while ")
    assert ": the system does that when memory runs out" in str(caught.value)
    assert str(caught.value).endswith("\nit ran the environments 2 to 3")


def test_an_environment_that_cannot_be_built(spec, start):
    workers = start(spec("FailsToStart"), 4)
    with pytest.raises(
        TaskError, match=r"^task '.*:FailsToStart': RuntimeError: no licence for this robot \(tests/play/envs.py:"
    ):
        workers.reset({0: 1})


def test_a_reset_that_fails_is_step_zero(spec, start):
    workers = start(spec("FailsToReset"), 4)
    with pytest.raises(TaskError) as caught:
        workers.reset({env: 40 + env for env in range(4)})
    assert str(caught.value).startswith(f"task '{ENVS}:FailsToReset': RuntimeError: cannot find home\n")
    assert "episode seed 4" in str(caught.value)
    assert ", step 0; " in str(caught.value)


PARENT = textwrap.dedent(
    """
    import sys
    from rlctl.environments.spec import EnvSpec
    from rlctl.play.messages import Play
    from rlctl.play.workers import Workers
    workers = Workers(EnvSpec(sys.argv[1], {"fault": "hang"}), 4, n_workers=2)
    workers.set_other_policy("zero")
    envs, first = range(4), int(sys.argv[2])
    workers.start_playing(Play(2, {env: env + first for env in envs}))
    workers.finish_playing()
    print("stepping", flush=True)
    while True:
        workers.start_playing(Play(1, dict.fromkeys(envs, -1), dict.fromkeys(envs, 1)))
        workers.finish_playing()
    """
)


@pytest.mark.slow
@pytest.mark.parametrize("first_seed", [pytest.param(5, id="stuck in a step"), pytest.param(100, id="at work")])
def test_workers_end_with_a_killed_parent(first_seed):
    command = [sys.executable, "-c", PARENT, f"{ENVS}:Walk", str(first_seed)]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert parent.stdout.readline() == b"stepping\n"
    time.sleep(0.2)
    workers = psutil.Process(parent.pid).children()
    assert len(workers) == 2
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    _, alive = psutil.wait_procs(workers, timeout=60)
    for each in alive:
        each.kill()
    assert alive == []


@pytest.mark.slow_except("True-15")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("built", [True, False])
def test_to_stop_is_for_the_main_process(spec, start, children, request, number, built):
    if number == signal.SIGINT:  # a fresh interpreter takes a while until it is ready for signals
        request.getfixturevalue("fresh_interpreters")
    workers = start(spec("Walk"), 2, n_workers=2)
    if built:
        workers.reset({0: 0, 1: 1})
    for process in children():
        process.send_signal(number)
    play(workers)
