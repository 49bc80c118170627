"""Why episodes of a policy and its export differ is found by playing again those that differ, the worst first."""

import pytest

from rlctl.exporting.verify import changes_again, list_different
from rlctl.play.collect import Episode
from rlctl.play.messages import EpisodeResult


def make_episodes(rewards, *, length=10):
    """Return episodes with these returns, whose seeds are their numbers."""
    return [Episode(EpisodeResult(0, seed, reward, length, True, {}, None)) for seed, reward in enumerate(rewards)]


EXPECTED = make_episodes([10.0, 10.0, 10.0, 10.0])


def test_the_worst_come_first_and_equal_ones_not_at_all():
    actual = make_episodes([10.0, 10.5, 11.0, 10.0])
    actual[3] = make_episodes([0.0, 0.0, 0.0, 10.0], length=9)[3]  # another length, whatever the return
    assert list_different(EXPECTED, actual) == [3, 2, 1]


@pytest.mark.parametrize(
    ("rewards", "exactly", "changes", "played"),
    [
        ([10.0, 10.0, 11.0, 11.0], False, True, [[3], [2]]),  # episode 2 is another: 1 is not played
        ([10.0, 10.0, 10.000001, 10.0], False, False, [[3], [2], [1]]),
        ([10.0, 10.0, 10.000001, 10.0], True, True, [[3], [2]]),
    ],
)
def test_playing_again_ends_with_the_first_that_is_another(rewards, exactly, changes, played):
    seeds = []

    def play(some):
        seeds.append(some)
        again = make_episodes([*rewards[:3], 10.0])
        return [again[seed] for seed in some]

    assert changes_again(EXPECTED, [3, 2, 1], play, 1, exactly=exactly) == changes
    assert seeds == played
