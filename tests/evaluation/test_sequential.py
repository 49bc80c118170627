"""A gate that is decided early: seldom wrong, soon where the answer is clear, the same for any number of workers."""

import json
import math

import numpy as np
import pytest

from rlctl.evaluation.sequential import ALPHA, find_interval, is_decided, is_settled


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


def test_clear_answers_end_early(rlctl):
    """`zero` never reaches a goal: (1 / 3) / 0.1^2 = 33 > 20 after two failures."""
    done = rlctl("eval", "reach", "--policy", "zero", "--min-success", "0.9", "--decide-early", "--json", "-")
    assert done.returncode == 1, done.stderr
    assert len(json.loads(done.stdout)["episodes"]) == 2


def test_it_needs_a_gate_on_success(rlctl):
    done = rlctl("eval", "reach", "--policy", "zero", "--decide-early")
    assert done.returncode == 2
    assert done.stderr.startswith("error: --decide-early needs --min-success")


def test_what_the_remaining_episodes_cannot_change():
    assert is_settled(0, 1, 100, 0.995)  # at most 99 of 100
    assert not is_settled(0, 1, 100, 0.99)
    assert is_settled(95, 96, 100, 0.95)
    assert not is_settled(94, 94, 100, 0.95)
