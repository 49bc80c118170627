"""Addresses name episodes for good: these seeds must never change."""

import itertools

from rlctl.play.seeds import Stream, episode_seed, episode_seeds


def test_seeds_stay_what_they_are():
    assert [int(stream) for stream in Stream] == [0, 1, 2, 3, 4, 5, 6]
    assert episode_seed(0, Stream.TRAIN, 0, 0) == 1839233791
    assert episode_seed(7, Stream.TRAIN, 3, 12) == 1373206606
    assert episode_seeds(0, Stream.EVAL, 3) == [1051823301, 1814578502, 1185059641]


def test_every_address_has_its_own_seed():
    addresses = itertools.product((0, 1), Stream, range(4), range(20))
    seeds = [episode_seed(*address) for address in addresses]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2**31 for seed in seeds)


def test_a_longer_list_begins_like_a_shorter_one():
    assert episode_seeds(3, Stream.EVAL, 10)[:4] == episode_seeds(3, Stream.EVAL, 4)
    assert episode_seeds(3, Stream.EVAL, 4)[2] == episode_seed(3, Stream.EVAL, 0, 2)
