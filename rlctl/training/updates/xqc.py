"""Updates of XQC without autograd; equal to `rlctl.policy.xqc` except for rounding."""

from typing import Any, ClassVar

import numpy as np

from rlctl.policy.xqc import XQC
from rlctl.training.updates.blocks import Arrays
from rlctl.training.updates.crossq import CrossQGradients, CrossQUpdate
from rlctl.training.updates.perceptrons import Floats
from rlctl.training.updates.sac_gradients import CRITICS, SacGradients, SacSettings


class XqcGradients(CrossQGradients):
    """CrossQ's gradients for critics that estimate the distribution of the return."""

    def __init__(self, arrays: Arrays, settings: SacSettings) -> None:
        super().__init__(arrays, settings)
        assert settings.atoms is not None
        self._support = np.linspace(*settings.atoms, settings.critic[-1], dtype=np.float32)

    def _make_target(self, outputs: Floats, penalty: Floats, rows: slice) -> Floats:
        """Return the distribution of the return, projected to the atoms; shape (batch, atoms)."""
        probabilities = _softmax(outputs)
        worse = (probabilities @ self._support).argmin(0)
        returns = self._take("rewards", rows) + self._take("discounts", rows) * (self._support - penalty)
        return project(probabilities[worse, np.arange(len(worse))], returns, self._support)

    def _compute_loss(self, outputs: Floats, target: Floats) -> float:
        logits = outputs - outputs.max(-1, keepdims=True)
        log_probabilities = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
        return -float((target * log_probabilities).sum())

    def _differentiate_loss(self, outputs: Floats, target: Floats) -> Floats:
        return (_softmax(outputs) - target) / np.float32(self._settings.rows)

    def _value(self, outputs: Floats) -> tuple[Floats, Floats]:
        probabilities = _softmax(outputs)
        values = (probabilities @ self._support)[..., None]
        value, to_values = super()._value(values)
        return value, to_values * probabilities * (self._support - values)


def project(probabilities: Floats, returns: Floats, support: Floats) -> Floats:
    """Move each probability from its return to the nearest two atoms of `support`; shape (batch, atoms) each.

    M. Bellemare et al., A Distributional Perspective on Reinforcement Learning, 2017, https://arxiv.org/abs/1707.06887.
    """
    first, last = support[[0, -1]]
    count = len(support)
    places = (returns.clip(first, last) - first) * ((count - 1) / (last - first))
    below = np.floor(places).clip(0, count - 2)
    above = probabilities * (places - below)
    index = (below.astype(np.intp) + np.arange(len(below))[:, None] * count).ravel()
    projected = np.bincount(index, (probabilities - above).ravel(), below.size)
    projected[1:] += np.bincount(index, above.ravel(), below.size)[:-1]
    return projected.reshape(below.shape).astype(np.float32)


def _softmax(logits: Floats) -> Floats:
    probabilities = np.exp(logits - logits.max(-1, keepdims=True))
    probabilities /= probabilities.sum(-1, keepdims=True)
    return probabilities


class XqcUpdate(CrossQUpdate):
    """Updates an XQC model whose networks are multi-layer perceptrons on the CPU."""

    algorithm: ClassVar[Any] = XQC
    gradients: ClassVar[type[SacGradients]] = XqcGradients

    def _step(self, phase: int) -> None:
        super()._step(phase)
        if phase == CRITICS:
            self._model.critic.project_weights()
