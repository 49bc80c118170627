"""A policy that acts for many environments at once: one forward pass for all rows.

An action has the same bits whatever the other rows are and however many there are.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.errors import DivergedError, in_world, short_repr
from rlctl.policy.file import DETERMINISTIC, PolicyFile
from rlctl.policy.layers import Activation, Array, Flatten, Layer, Linear, Normalize
from rlctl.policy.network import Network
from rlctl.policy.players.player import NOISE_BLOCK, Exploration, draw_matrix, draw_noise

_SIZES = (64, 32, 16, 8, 4, 2)
"""Numbers of rows in a matrix product, the fastest first."""
_ROWWISE = (Linear, Activation, Normalize, Flatten)


class RowsPolicy:
    """Acts with a policy file for `count` environments; their weights may change between segments."""

    def __init__(self, policy: PolicyFile, count: int) -> None:
        self._network = Network(policy)
        self._space = policy.info.env.spaces()[1]
        assert isinstance(self._space, spaces.Box)
        self._low, self._high = self._space.low.ravel(), self._space.high.ravel()
        size = len(self._low)
        self._normal = np.zeros((count, NOISE_BLOCK, size), np.float32)
        self._drawn = np.full((count, 2), -1, np.int64)  # seed and block of the noise of each environment
        shapes = [layer.weight.shape for layer in self._layers() if isinstance(layer, Linear)]
        self._block = min(find_block(shape) for shape in shapes)
        self._uses_sde = bool(policy.info.policy_kwargs.get("use_sde"))
        if self._uses_sde:
            self._matrices = np.zeros((count, shapes[-1][1], size), np.float32)
            self._has_matrix = np.zeros(count, bool)

    @staticmethod
    def supports(policy: PolicyFile) -> bool:
        """Return whether it acts as this policy does: a Gaussian or deterministic perceptron on a flat observation."""
        info = policy.info
        observed, space = info.env.spaces()
        if info.algo == "recurrent_ppo" or not isinstance(space, spaces.Box):
            return False
        network = Network(policy)
        if not isinstance(observed, spaces.Box) or network.own is not None or network.is_squashed:
            return False
        layers = [*network.parts[""], *network.trunk, *network.head]
        return info.algo not in DETERMINISTIC and all(isinstance(layer, _ROWWISE) for layer in layers)

    def _layers(self) -> list[Layer]:
        return [*self._network.parts[""], *self._network.trunk, *self._network.head]

    def begin_segment(self) -> None:
        """Use the present weights; gSDE draws new matrices."""
        self._network.prepare()
        if self._uses_sde:
            self._has_matrix[:] = False

    def act(
        self,
        observations: NDArray[Any],
        seeds: NDArray[np.int64],
        steps: NDArray[np.int64],
        rows: NDArray[np.int64],
        exploration: Exploration,
    ) -> tuple[Array, NDArray[Any]]:
        """Return the actions to store, shape (k, elements), and those for the environments `rows`, shape (k, ...).

        Raises `DivergedError` for an action that is not finite.
        """
        network = self._network
        latent = self._apply([*network.parts[""], *network.trunk], observations)
        value = self._apply(network.head, latent)
        if exploration.stochastic:
            assert network.std is not None  # of a Gaussian policy
            if self._uses_sde:
                value = value + self._explore(latent, seeds, steps, rows, exploration.sde_every)
            else:
                value = value + network.std * self._draw(seeds, steps, rows)
        if not np.isfinite(value.sum()):
            bad = int((~np.isfinite(value)).any(axis=1).argmax())
            with in_world(int(rows[bad])):
                raise DivergedError(f"the policy's action is not finite: {short_repr(value[bad].tolist())}")
        action = np.minimum(np.maximum(value, self._low), self._high).astype(self._space.dtype, copy=False)
        return value, action.reshape(len(rows), *self._space.shape)  # type: ignore[misc]

    def _apply(self, layers: list[Layer], inputs: NDArray[Any]) -> Array:
        count, block = len(inputs), self._block
        value = np.zeros((-(-count // block) * block, inputs[0].size), np.float32)
        value[:count] = inputs.reshape(count, -1)
        for layer in layers:
            if isinstance(layer, Linear):
                product = np.empty((len(value), len(layer.weight)), np.float32)
                for start in range(0, len(value), block):
                    np.matmul(value[start : start + block], layer.weight.T, out=product[start : start + block])
                value = product + layer.bias
            elif not isinstance(layer, Flatten):
                value = layer(value)
        return value[:count]

    def _explore(
        self, latent: Array, seeds: NDArray[np.int64], steps: NDArray[np.int64], rows: NDArray[np.int64], period: int
    ) -> Array:
        """Return gSDE's noise, shape (k, elements): the latent values times the matrices, new ones each `period`."""
        std = self._network.std
        assert std is not None  # of gSDE's parameter
        new = ~self._has_matrix[rows]
        if period:
            new |= steps % period == 0
        for k in np.flatnonzero(new).tolist():
            self._matrices[rows[k]] = draw_matrix(std, int(seeds[k]), int(steps[k]), len(self._low))
        self._has_matrix[rows] = True
        # A sum over an axis that is not the last one adds in order: its bits do not depend on the other rows.
        noise: Array = (latent[:, :, None] * self._matrices[rows]).sum(axis=1)
        return noise

    def _draw(self, seeds: NDArray[np.int64], steps: NDArray[np.int64], rows: NDArray[np.int64]) -> Array:
        """Return the noise of the steps of episodes, shape (k, elements): the same numbers as for one environment."""
        blocks, places = np.divmod(steps, NOISE_BLOCK)
        drawn = self._drawn[rows]
        for k in np.flatnonzero((drawn[:, 0] != seeds) | (drawn[:, 1] != blocks)).tolist():
            row = rows[k]
            self._drawn[row] = seeds[k], blocks[k]
            self._normal[row] = draw_noise(int(seeds[k]), int(blocks[k]), len(self._low))[0][:, 0]
        noise: Array = self._normal[rows, places]
        return noise


@functools.cache
def find_block(shape: tuple[int, int]) -> int:
    """Return the largest number of rows whose product with weights of this shape does not depend on a row's place.

    BLAS computes rows at different places with different code, so that their last bits may differ.
    """
    rng = np.random.default_rng(0)
    weight = rng.standard_normal(shape).astype(np.float32)
    for size in _SIZES:
        rows = rng.standard_normal((size, shape[1])).astype(np.float32)
        product = rows @ weight.T
        if all((np.roll(rows, shift, 0) @ weight.T == np.roll(product, shift, 0)).all() for shift in range(1, size)):
            return size
    return 1
