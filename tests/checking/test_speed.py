"""The family RL9: what is slow is measured, and named."""

import cProfile
import dataclasses
import time

import numpy as np
import pytest

from rlctl.checking.check import judge
from rlctl.checking.experiments.speed import typical
from rlctl.checking.profiling import Profile, Stopwatch, TimedCall
from rlctl.checking.records import Records
from rlctl.checking.rule_index import choose_rules
from rlctl.checking.speed import Speed, format_speed
from tests.checking.judging import case, check_case, mark_slow, shared_records_of

CASES = [
    case("broken_speed.py:RL901SlowStep", ("RL901", "warning"), slow=True),
    case("broken_speed.py:RL903Sleeps", ("RL903", "warning"), slow=True),
    case("broken_speed.py:RL903Renders", ("RL903", "warning"), twin="broken_speed.py:RL903Sees", slow=True),
    case("broken_speed.py:RL904ReadsFile", ("RL904", "warning"), slow=True),
    case(
        "broken_speed.py:RL904Reconnects", ("RL904", "warning"), twin="broken_speed.py:World", pybullet=True, slow=True
    ),
]
STEP = TimedCall("pybullet.stepSimulation", "world.py:10", 0.61)
NOTHING = Speed(66e-6, 52e-6, 200, 5, [STEP], [], [], False)


def measured(task):
    """What only the experiments that this family reads find out."""
    return shared_records_of(task, "episodes", "speed")


def with_speed(**changes):
    """`Clean`, whose episodes have 50 steps, with another speed."""
    result = dataclasses.replace(NOTHING, **changes)
    return dataclasses.replace(measured("broken_envs.py:Clean"), facts={"speed": result})


def findings(evidence):
    verdict = judge(evidence, choose_rules(["RL9"]))
    assert (verdict.crashed, verdict.not_judged) == ({}, {})
    return verdict.findings


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [
        "reach",
        "CartPole-v1",
        "broken_envs.py:Clean",
        "broken_speed.py:RL903Sees",
        "broken_speed.py:RendersNothing",
        pytest.param("broken_speed.py:World", marks=pytest.mark.pybullet),
        pytest.param("broken_speed.py:KeepsPartials", marks=pytest.mark.pybullet),
    ],
)
def test_what_is_fast_has_no_finding(task):
    assert findings(measured(task)) == []
    assert "steps/s: a million steps take " in format_speed(measured(task))


def test_slow_has_hours_and_the_slowest_calls():
    # 36 ms a step: 27.8 steps/s; 1e6 * 0.036 s = 36,000 s = 10 hours.
    calls = [STEP, TimedCall("Ant.observe", "ant.py:50", 0.2), TimedCall("numpy.dot", "", 0.004)]
    (finding,) = findings(with_speed(step_s=0.036, slowest_in_step=calls))
    assert (finding.rule, finding.severity) == ("RL901", "warning")
    assert finding.message == (
        "27.8 steps/s: a million steps take 10 hours per process on this machine; "
        "slowest: pybullet.stepSimulation 61% (world.py:10), Ant.observe 20% (ant.py:50)"
    )
    assert finding.evidence == {"value": 1 / 0.036, "expected": 100.0, "step_ms": 36.0, "steps": 200}


def test_slow_without_a_slow_call_is_an_info():
    calls = [TimedCall("Road.neighbours", "road.py:7", 0.06), TimedCall("numpy.dot", "", 0.04)]
    (finding,) = findings(with_speed(step_s=0.036, slowest_in_step=calls))
    assert (finding.rule, finding.severity) == ("RL901", "info")


def test_just_fast_enough_is_no_finding():
    assert findings(with_speed(step_s=0.0099)) == []


def test_slow_for_what_another_rule_names_is_said_once():
    camera = TimedCall("pybullet.getCameraImage", "world.py:9", 0.8, "rendering")
    (finding,) = findings(with_speed(step_s=0.036, suspicious_in_step=[camera]))
    # 80 % of 36 ms; the 7.2 ms that are left are fast enough.
    assert (finding.rule, finding.message) == (
        "RL903",
        "step calls pybullet.getCameraImage (world.py:9): 28.8 ms per step, 80% of its time",
    )


def test_loading_in_reset_is_said_once_and_by_its_weight():
    load = TimedCall("pybullet.loadURDF", "maze.py:9", 0.9, "loading")
    (finding,) = findings(with_speed(step_s=200e-6, reset_s=0.03, suspicious_in_reset=[load]))
    assert (finding.rule, finding.severity) == ("RL904", "warning")
    # 27 of 40 ms.
    assert finding.message == "reset calls pybullet.loadURDF (maze.py:9): 27 ms per reset, 68% of an episode"
    # 27 ms of 30 + 50 * 20 ms.
    assert findings(with_speed(step_s=0.0099, reset_s=0.02, suspicious_in_reset=[load])) == []
    assert findings(with_speed(step_s=200e-6, reset_s=0.005, suspicious_in_reset=[load])) == []


def test_connecting_in_reset_is_named_however_fast_it_is():
    connect = TimedCall("pybullet.connect", "maze.py:9", 0.01, "connecting")
    (finding,) = findings(with_speed(suspicious_in_reset=[connect]))
    assert (finding.rule, finding.severity) == ("RL904", "info")


@pytest.mark.slow
def test_a_task_that_says_that_it_reloads_may_load():
    evidence = measured("broken_speed.py:ReloadingTask")
    assert evidence.facts["speed"].rebuilds
    assert findings(evidence) == []


@pytest.mark.slow
@pytest.mark.pybullet
def test_calls_through_a_bullet_client_are_seen():
    finding, *more = findings(measured("broken_speed.py:CameraAtEveryStep"))
    assert (finding.rule, more) == ("RL903", [])
    assert finding.message.startswith("step calls pybullet.getCameraImage (broken_speed.py:")
    assert finding.evidence["share"] > 0.5


@pytest.mark.slow
@pytest.mark.pybullet
def test_rebuilding_is_named_with_its_calls():
    (finding,) = findings(measured("broken_speed.py:Rebuilds"))
    assert (finding.rule, finding.severity) == ("RL904", "warning")
    assert "pybullet.loadURDF (broken_speed.py:" in finding.message
    assert "pybullet.resetSimulation (broken_speed.py:" in finding.message


@pytest.mark.slow
def test_waiting_in_reset_is_said_once():
    (finding,) = findings(measured("broken_speed.py:SleepsInReset"))
    assert (finding.rule, finding.evidence["value"]) == ("RL903", "time.sleep")


def test_line_for_the_report():
    # 50 steps of 66 us and a reset of 52 us: 3.352 ms, of which the reset is 1.6 %; 14,916 steps/s, 67 s.
    assert format_speed(with_speed()) == (
        "step 66 us, reset 52 us (1.6% of an episode), 15,000 steps/s: a million steps take 67 s; "
        "slowest: pybullet.stepSimulation 61% (world.py:10)"
    )
    assert format_speed(Records("any")) == ""
    assert format_speed(with_speed(is_batch=True)).endswith(
        "(world.py:10); this is one world alone, those of a batch are several times faster"
    )


def test_a_step_that_takes_longer_now_and_then_counts_and_a_disturbance_does_not():
    # Batches of 5: four steps of 1 s and one of 6 s, 2 s on average. In one batch something else ran for 1000 s.
    batches = [[1, 1, 1, 1, 6], [1, 1, 1, 1, 1006], [1, 1, 1, 1, 6], [1, 1]]
    assert typical([each for batch in batches for each in batch], 5) == 2
    assert typical([3, 5], 5) == 4
    assert typical([], 5) is None


def pause():
    time.sleep(0.02)


def twice():
    pause()
    sorted([2, 1], key=lambda each: time.sleep(0.01) or each)


def profiled(function, repetitions=20):
    profiler = cProfile.Profile()
    for _ in range(repetitions):
        profiler.runcall(function)
    return Profile(profiler, lambda file: file == __file__)


def test_time_is_booked_on_who_takes_it():
    profile = profiled(twice)
    (sleep,) = profile.suspicious()
    # 20 ms in pause and 10 ms twice in the key function, each by time.sleep.
    assert (sleep.name, sleep.kind) == ("time.sleep", "sleeping")
    assert 0.8 <= sleep.share <= 1
    assert sleep.place.startswith("test_speed.py:")
    assert profile.slowest()[0].name == "time.sleep"


def test_builtins_are_named_by_what_is_called():
    assert profiled(lambda: sorted(range(300_000), key=float), 3).slowest()[0].name == "sorted"
    numbers = np.ones(1_000_000)  # made and freed here: that would be the lambda's own time
    assert profiled(lambda: np.linalg.norm(numbers), 3).slowest()[0].name.startswith("numpy.")


@pytest.mark.usefixtures("busy")
def test_waiting_for_a_processor_does_not_count():
    watch, begun = Stopwatch(), time.monotonic()
    watch(work, 0.1)
    # Of four processes this one has a quarter of the time.
    assert 0.09 < watch.seconds[0] < 0.6 * (time.monotonic() - begun)


def work(seconds):
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass
