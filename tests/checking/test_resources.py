"""What an instance takes and does not give back, and what instances share."""

import pytest

from rlctl.checking.check import judge
from rlctl.checking.experiments.episodes import record_episodes
from rlctl.checking.instance import Context
from rlctl.checking.progress import read_clock
from rlctl.checking.rule import NotJudged
from rlctl.checking.rules import rl405_leaks_on_reset as leaks
from rlctl.checking.rules.rl311_random_generator_without_a_seed import find_unseeded
from rlctl.environments.spec import EnvSpec
from tests.checking.judging import case, check_case, findings, mark_slow, records_of

FILE = "broken_resources.py"
CASES = [
    case(f"{FILE}:RL405LeavesBodies", ("RL405", "error"), twin="broken_repeats.py:OwnWorld", pybullet=True, slow=True),
    case(f"{FILE}:RL405KeepsFiles", ("RL405", "warning"), slow=True),
    case(f"{FILE}:RL405KeepsThreads", ("RL405", "warning"), slow=True),
    case(f"{FILE}:RL405KeepsMemory", ("RL405", "warning"), twin=f"{FILE}:RL405Caches", slow=True),
    case(f"{FILE}:RL404ClassSpaces", ("RL404", "warning")),
    case(f"{FILE}:RL404ClassObservations", ("RL404", "info")),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


def the_finding(name, rule):
    (finding,) = findings(f"{FILE}:{name}", rule)
    return finding


@pytest.mark.slow
@pytest.mark.pybullet
def test_each_reset_leaves_a_client(monkeypatch):
    monkeypatch.setattr(leaks, "MOST_RESETS", 12)  # each is slow: PyBullet connects anew
    (finding,) = judge(records_of(f"{FILE}:Reconnects", "build", "leaks"), ["RL405"]).findings
    assert finding.severity == "error"
    assert finding.evidence["per_reset"] == 1.0
    assert finding.evidence["value"] - finding.evidence["expected"] == finding.evidence["resets"] == 9
    assert finding.message.startswith("PyBullet clients grow with every reset: from ")
    assert judge(records_of(f"{FILE}:ReconnectsProperly", "build", "leaks"), ["RL405"]).findings == []


@pytest.mark.slow
def test_memory_is_counted():
    finding = the_finding("RL405KeepsMemory", "RL405")
    # 50,000 numbers of 8 bytes.
    assert finding.evidence["per_reset"] == pytest.approx(400_000, rel=0.1)
    assert finding.evidence["resets"] == 90


def found_in(resets, bodies=None, **memory):
    series = {"bodies in the PyBullet world": bodies} if bodies else {}
    return [finding.message for finding in leaks.find_growth(leaks.Counts(resets, series, **memory))]


def test_what_changes_or_fills_once_is_no_leak():
    assert found_in(20, [3, 7, 5, 9, 4] * 4) == []
    assert found_in(20, [*range(10), *[10] * 10]) == []
    assert found_in(20, [5] * 19 + [6]) == []
    (message,) = found_in(20, list(range(20)))
    assert message == "bodies in the PyBullet world grow with every reset: from 2 to 19 in 17 resets"


def test_memory_needs_resets_and_a_second_half():
    mib = 2**20
    # Measured after every ten resets.
    assert found_in(40, memory=[100 * mib, 103 * mib, 107 * mib, 110 * mib])
    assert not found_in(20, memory=[100 * mib, 110 * mib])
    assert not found_in(40, memory=[100 * mib, 107 * mib, 109 * mib, 110 * mib])
    assert not found_in(40, memory=[100 * mib, 102 * mib, 105 * mib, 107 * mib])


def test_too_few_resets_are_not_judged():
    with pytest.raises(NotJudged, match="time ran out after 4 resets"):
        found_in(4, [1, 2, 3, 4])


@pytest.mark.slow
def test_a_task_without_generators_plays_its_episodes_once():
    context = Context(EnvSpec("reach"))
    context.budget.deadline = read_clock() + 60
    assert len(list(record_episodes.run(context))) >= 5
    assert context.generators == {}
    assert not list(find_unseeded.run(context))
