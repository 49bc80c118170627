"""Episode addresses: (run seed, stream, environment, episode) determines the seed of every episode."""

import enum
import itertools
from collections.abc import Iterator

import numpy as np


class Stream(enum.IntEnum):
    """What episodes are for; streams never share a seed."""

    TRAIN = 0
    EVAL_IN_TRAINING = 1
    EVAL = 2
    REPLAY = 3
    VERIFY = 4
    CHECK = 5
    AGE = 6  # how long the first episode of an environment is


def episode_seed(run_seed: int, stream: Stream, env_index: int, episode: int) -> int:
    """Return the seed that an episode's address gives to `env.reset`, in [0, 2**31)."""
    sequence = np.random.SeedSequence(run_seed, spawn_key=(int(stream), env_index, episode))
    # Some environments pass the seed to a generator that takes signed 32-bit numbers.
    return int(sequence.generate_state(1)[0]) >> 1


def first_length(run_seed: int, env_index: int, episode: int, longest: int) -> int:
    """Return the length [steps], from 1 to `longest`, of an episode that begins together with all other environments'.

    With episodes of mixed lengths at first, environments are at different steps of their episodes ever after.
    """
    return 1 + episode_seed(run_seed, Stream.AGE, env_index, episode) % longest


def list_training_seeds(run_seed: int, env_index: int, first: int) -> Iterator[int]:
    """Return the seeds of an environment's training episodes from number `first` on, without end."""
    return (episode_seed(run_seed, Stream.TRAIN, env_index, number) for number in itertools.count(first))


def episode_seeds(run_seed: int, stream: Stream, episodes: int) -> list[int]:
    """Return the seeds of a numbered list of episodes; any environment may play any of them."""
    return [episode_seed(run_seed, stream, 0, index) for index in range(episodes)]
