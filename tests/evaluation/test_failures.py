"""What failed episodes have in common."""

import numpy as np
import pytest

from rlctl.environments.info import EnvInfo
from rlctl.evaluation import failures
from rlctl.evaluation.failures import find_patterns
from rlctl.play.collect import Episode
from rlctl.play.messages import EpisodeResult

INFO = EnvInfo(observation_space={}, action_space={}, observation_sizes={"goal": 2, "speed": 1})


def play(seed, fails, count=100):
    """Return episodes whose failures depend on the condition `friction`, or on what was observed at first."""
    rng = np.random.default_rng(seed)
    episodes = []
    for _ in range(count):
        friction, first = rng.uniform(0.2, 1.0), rng.uniform(-1.0, 1.0, 3)
        drawn = {"friction": {"friction": friction}, "mass": {"factor": rng.uniform(0.8, 1.2)}}
        success = not fails(rng.random(), friction, first)
        episodes.append(Episode(EpisodeResult(0, 0, 0.0, 10, success, {}, None, drawn=drawn), first={"": first}))
    return episodes


@pytest.mark.parametrize(
    ("fails", "condition", "where"),
    [
        (lambda luck, friction, first: friction < 0.4 and luck < 0.8, "friction", "at most"),
        (lambda luck, friction, first: first[1] > 0.4 and luck < 0.8, "goal[1]", "at least"),
        (lambda luck, friction, first: abs(first[2]) > 0.6 and luck < 0.8, "speed", "far from the middle"),
    ],
)
def test_failures_are_described_by_the_condition_they_depend_on(fails, condition, where):
    patterns = find_patterns(play(0, fails), INFO)
    assert (patterns[0].condition, patterns[0].where) == (condition, where)
    first = patterns[0]
    assert first.failures / first.episodes > 0.4
    assert first.other_failures / first.other_episodes < 0.2
    assert first.episodes + first.other_episodes == 100


def test_a_pattern_is_one_line():
    (pattern,) = find_patterns(play(0, lambda luck, friction, first: friction < 0.4), INFO)
    assert str(pattern).startswith("23 of 34 with friction <= 0.524 fail, 0 of 66 others (p = ")


@pytest.mark.slow
def test_failures_by_chance_have_nothing_in_common(monkeypatch):
    monkeypatch.setattr(failures, "_RELABELLED", 200)  # the smallest p-value is 0.005
    found = [bool(find_patterns(play(seed, lambda luck, *_: luck < 0.2), INFO)) for seed in range(60)]
    assert sum(found) <= 3  # at most 1 in 100 is expected; more than 3 of 60 has a probability of 0.4 %


@pytest.mark.parametrize("rate", [0.02, 0.98])
def test_a_handful_of_failures_or_successes_says_nothing(rate):
    assert find_patterns(play(0, lambda luck, friction, first: friction < 0.2 + 0.8 * rate), INFO) == []
