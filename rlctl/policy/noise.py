"""Random numbers of actions: they depend only on the seed of the episode and on the step."""

import functools

import numpy as np

from rlctl.policy.actor import Array, Rows

NOISE_BLOCK = 64
"""Number of steps whose random numbers are drawn together."""
_STEP_NOISE, _MATRIX = 0, 1  # random streams: noise of steps, gSDE's matrices


class StepNoise:
    """Random numbers of the steps of the episodes in `count` rows; they do not depend on which were drawn before."""

    def __init__(self, count: int, size: int) -> None:
        """Draw for actions of `size` elements."""
        self._count, self._size = count, size

    @functools.cached_property
    def sample(self) -> "NumbersOfSteps":
        """Standard normal numbers for the policy's distribution, `size` in each step."""
        return NumbersOfSteps("sample", self._count, self._size)

    @functools.cached_property
    def disturb(self) -> "NumbersOfSteps":
        """Standard normal numbers, independent of those of `sample`, `size` in each step."""
        return NumbersOfSteps("disturb", self._count, self._size)

    @functools.cached_property
    def uniform(self) -> "NumbersOfSteps":
        """Uniform numbers in [0, 1), `size + 1` in each step."""
        return NumbersOfSteps("uniform", self._count, self._size)


class NumbersOfSteps:
    """The present block of steps of each row, of one kind of random numbers."""

    def __init__(self, kind: str, count: int, size: int) -> None:
        self._kind, self._size = kind, size
        self._drawn = [(-1, -1)] * count  # seed and number of the block of each row
        one = draw_noise(0, 0, size)[kind]
        self._numbers = np.zeros((count, *one.shape), one.dtype)

    def draw(self, rows: Rows) -> Array:
        """Return the numbers of the present steps of rows, shape (k, numbers)."""
        numbers: Array
        if len(rows.index) == 1:  # arithmetic with Python's numbers takes a fifth of the time
            row = rows.index.item()
            block, place = divmod(rows.step.item(), NOISE_BLOCK)
            self._fill(row, rows.seed.item(), block)
            numbers = self._numbers[row, place : place + 1]
            return numbers
        blocks, places = np.divmod(rows.step, NOISE_BLOCK)
        for row, seed, block in zip(rows.index.tolist(), rows.seed.tolist(), blocks.tolist(), strict=True):
            self._fill(row, seed, block)
        numbers = self._numbers[rows.index, places]
        return numbers

    def _fill(self, row: int, seed: int, block: int) -> None:
        if self._drawn[row] != (seed, block):
            self._drawn[row] = seed, block
            self._numbers[row] = draw_noise(seed, block, self._size)[self._kind]


def draw_noise(seed: int, block: int, size: int) -> dict[str, Array]:
    """Return the random numbers of a block of steps of an episode, by the names of `StepNoise`."""
    generator = make_generator(seed, _STEP_NOISE, block)
    normal = generator.standard_normal((NOISE_BLOCK, 2, size), np.float32)
    uniform = generator.random((NOISE_BLOCK, size + 1))
    return {"sample": normal[:, 0], "disturb": normal[:, 1], "uniform": uniform}


def draw_matrix(std: Array, seed: int, step: int, actions: int) -> Array:
    """Return gSDE's exploration matrix of a step, shape (latent, actions).

    `std` has a column for each action, or one for all: shape (latent, actions) or (latent, 1).
    """
    matrix: Array = std * make_generator(seed, _MATRIX, step).standard_normal((len(std), actions), np.float32)
    return matrix


def make_generator(seed: int, use: int, counter: int) -> np.random.Generator:
    """Return the generator of a step or block (`counter`) of an episode, in the random stream `use`."""
    # A counter-based generator can start anywhere without drawing the numbers before.
    return np.random.Generator(np.random.Philox(key=np.array([seed, use], np.uint64), counter=[0, counter, 0, 0]))
