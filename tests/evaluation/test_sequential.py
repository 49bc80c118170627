"""A gate that is decided early: seldom wrong, soon where the answer is clear, the same for any number of workers."""

import json
import math

import numpy as np
import pytest

from rlctl.evaluation.sequential import ALPHA, EarlyGate, find_interval, find_least_episodes, is_decided, is_settled


@pytest.mark.parametrize("rate", [0.5, 0.9])
def test_under_the_null_few_gates_are_decided(rate):
    """2,000 evaluations of 300 episodes whose true rate is that of the gate: at most 5 % may be decided."""
    rng = np.random.default_rng(0)
    counts = np.cumsum(rng.random((2000, 300)) < rate, axis=1)
    decided = np.zeros(2000, bool)
    for episodes in range(1, 301):
        out = [is_decided(successes, episodes, rate) for successes in range(episodes + 1)]
        decided |= np.array(out)[counts[:, episodes - 1]]
    assert 0 < decided.mean() <= ALPHA


@pytest.mark.slow_except("0.88-0.9")
@pytest.mark.parametrize(("true", "rate"), [(0.5, 0.5), (0.88, 0.9)])
def test_under_the_null_the_lower_end_seldom_passes(true, rate):
    """1,000 evaluations of 200 episodes: fewer than 5 % pass by the lower end, but many more by the measured rate."""
    passed = {on_lower_end: _play_gates(EarlyGate(rate, on_lower_end), true) for on_lower_end in (True, False)}
    assert passed[True] <= ALPHA
    assert passed[False] > 3 * ALPHA


def _play_gates(gate, true, planned=200):
    """The part of the evaluations that pass."""
    counts = np.cumsum(np.random.default_rng(0).random((1000, planned)) < true, axis=1)
    passed, playing = np.zeros(1000, bool), np.ones(1000, bool)
    for episodes in range(1, planned + 1):
        ends, passes = np.zeros((2, episodes + 1), bool)
        for successes in np.unique(counts[playing, episodes - 1]).tolist():
            ends[successes] = episodes == planned or gate.explain_end(successes, episodes, planned) != ""
            score = find_interval(successes, episodes)[0] if gate.on_lower_end else successes / episodes
            passes[successes] = ends[successes] and score >= gate.rate
        now = counts[:, episodes - 1]
        passed |= playing & passes[now]
        playing &= ~ends[now]
    return passed.mean()


def test_a_lower_end_passes_where_it_reaches_the_gate():
    gate = EarlyGate(0.5, on_lower_end=True)
    # All succeed: 1 / (n + 1) / 0.5^n, which is 18.3 for n = 7 and 28.4 for n = 8.
    assert [bool(gate.explain_end(n, n, 100)) for n in (7, 8)] == [False, True]
    assert find_least_episodes(0.5) == 8
    # Of 10 episodes with two failures: 10! / (8! 2!) = 45, so 1 / (11 * 45) / 0.5^10 = 2.1 at most.
    assert gate.explain_end(0, 2, 10) == "with 2 failures the interval can no longer begin at 0.5"
    assert not EarlyGate(0.5, on_lower_end=False).explain_end(0, 2, 10)


def test_a_ratio_by_hand():
    # 3 of 3 succeed. Uniform prior: 1 / 4 (the beta function of 4 and 1); under 0.2: 0.008. 0.25 / 0.008 = 31 > 20.
    assert is_decided(3, 3, 0.2)
    # Under 0.3: 0.027, 0.25 / 0.027 = 9.3 < 20.
    assert not is_decided(3, 3, 0.3)
    # The bound is where the ratio is 20: (0.25 / 20) ** (1 / 3) = 0.232.
    assert find_interval(3, 3) == (pytest.approx(0.2321, abs=1e-4), 1.0)


@pytest.mark.parametrize(("successes", "episodes"), [(0, 1), (1, 1), (0, 40), (40, 40), (13, 40), (999_000, 1_000_000)])
def test_the_interval_contains_the_rate(successes, episodes):
    low, high = find_interval(successes, episodes)
    assert 0 <= low <= successes / episodes <= high <= 1
    assert math.isfinite(low + high)


@pytest.mark.slow
def test_clear_answers_end_early(rlctl):
    """`zero` never reaches a goal: (1 / 3) / 0.1^2 = 33 > 20 after two failures."""
    done = rlctl("eval", "reach", "--policy", "zero", "--min-success", "0.9", "--decide-early", "--json", "-")
    assert done.returncode == 1, done.stderr
    content = json.loads(done.stdout)
    assert len(content["episodes"]) == 2
    assert (content["format"], content["exit_code"], content["passed"]) == ("rlctl eval 1", 1, False)
    assert content["planned_episodes"] == 100
    assert content["end"] == "0.9 is outside the interval, which is valid at any time"
    assert content["interval"] == "valid at any time, 95 %"


def test_it_needs_a_gate_on_success(rlctl):
    done = rlctl("eval", "reach", "--policy", "zero", "--decide-early")
    assert done.returncode == 2
    assert done.stderr.startswith("error: --decide-early needs either --min-success or --min-success-lower")


def test_a_lower_end_that_cannot_be_reached_is_refused_before_playing(rlctl):
    done = rlctl("eval", "reach", "--policy", "zero", "--min-success-lower", "0.95", "--decide-early")
    assert done.returncode == 2
    # (0.05 / 101)^(1 / 100) = 0.927; 0.95^n <= 0.05 / (n + 1) from n = 158 on.
    assert done.stderr == "error: --min-success-lower 0.95: 100 successes reach at most 0.927; use --episodes 158\n"


def test_what_the_remaining_episodes_cannot_change():
    assert is_settled(0, 1, 100, 0.995)  # at most 99 of 100
    assert not is_settled(0, 1, 100, 0.99)
    assert is_settled(95, 96, 100, 0.95)
    assert not is_settled(94, 94, 100, 0.95)


@pytest.mark.parametrize("text", ["90%", "90 %", "90"])
def test_a_rate_in_percent_is_explained(rlctl, text):
    done = rlctl("eval", "reach", "--policy", "zero", "--min-success", text)
    assert done.returncode == 2
    assert done.stderr.endswith(f"{text}: a rate is between 0 and 1; 90 % is 0.9\n")
