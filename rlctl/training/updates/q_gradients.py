"""Gradients of the losses of DQN, TD3 and DDPG for one row block of a minibatch, in NumPy; see `q_learning.py`."""

import dataclasses
import math

import numpy as np

from rlctl.play.shared_arrays import ArrayLayout
from rlctl.training.updates.blocks import MAX_BLOCKS, Arrays, BlockWork, select_block
from rlctl.training.updates.perceptrons import ArrayShapes, Floats, MlpStack, count_floats, list_shapes, split_vector

CRITICS, ACTOR = 0, 1  # phases; DQN has only the first


@dataclasses.dataclass(frozen=True)
class QSettings:
    """Networks; sizes are those of the inputs and of each layer's outputs, `actor` is empty for DQN."""

    rows: int  # of a minibatch
    features: int
    actions: int  # elements of a stored action
    critic: tuple[int, ...]
    critics: int
    critic_uses_tanh: bool
    actor: tuple[int, ...] = ()
    actor_uses_tanh: bool = False

    def list_critic_shapes(self) -> ArrayShapes:
        """Return the shapes of the critics' parameters, which come first."""
        return list_shapes(self.critic, self.critics)

    def list_shapes(self) -> ArrayShapes:
        """Return the shapes of all trained parameters."""
        return [*self.list_critic_shapes(), *list_shapes(self.actor)]

    def make_layout(self) -> ArrayLayout:
        """Return the arrays that all processes share besides the parameters and their gradients."""
        floats = np.dtype(np.float32)
        return {
            "targets": ((count_floats(self.list_shapes()),), floats),  # parameters of the target networks
            "features": ((self.rows, self.features), floats),
            "next_features": ((self.rows, self.features), floats),
            "actions": ((self.rows, self.actions), floats),
            "rewards": ((self.rows, 1), floats),
            "discounts": ((self.rows, 1), floats),
            "noise": ((self.rows, self.actions), floats),  # of the target policy
            "count": ((), np.dtype(np.int64)),  # of blocks
            "losses": ((MAX_BLOCKS, 2), np.dtype(np.float64)),  # sums of each block
        }

    def count_weights(self) -> int:
        """Return the number of trained parameters."""
        return sum(math.prod(shape) for shape in self.list_shapes())


class QGradients(BlockWork):
    """Holds networks, targets and gradients; TD3's critics are updated before its actor."""

    def __init__(self, arrays: Arrays, settings: QSettings) -> None:
        self._arrays, self._settings = arrays, settings
        split = len(settings.list_critic_shapes())
        self._critics, self._actor = self._make_networks("parameters", split)
        self._target_critics, self._target_actor = self._make_networks("targets", split)
        gradients = [split_vector(row, settings.list_shapes()) for row in arrays["gradients"]]
        self._gradients = [(row[:split], row[split:]) for row in gradients]

    def _make_networks(self, name: str, split: int) -> tuple[MlpStack, MlpStack]:
        parameters = split_vector(self._arrays[name], self._settings.list_shapes())
        return (
            MlpStack(parameters[:split], uses_tanh=self._settings.critic_uses_tanh),
            MlpStack(parameters[split:], uses_tanh=self._settings.actor_uses_tanh),
        )

    def compute(self, phase: int, task: int) -> None:
        """Set a block's gradients of the minibatch's mean loss, and its sum of the loss."""
        rows = select_block(task, int(self._arrays["count"]), 0, self._settings.rows)
        differentiate = self._differentiate_critics if phase == CRITICS else self._differentiate_actor
        self._arrays["losses"][task, phase] = differentiate(rows, self._gradients[task][phase])

    def _differentiate_critics(self, rows: slice, gradients: list[Floats]) -> float:
        raise NotImplementedError

    def _differentiate_actor(self, rows: slice, gradients: list[Floats]) -> float:
        raise NotImplementedError


class DqnGradients(QGradients):
    """Its network returns the values of all actions."""

    def _differentiate_critics(self, rows: slice, gradients: list[Floats]) -> float:
        arrays = self._arrays
        best = self._target_critics.run(arrays["next_features"][None, rows], "target")[-1][0].max(1, keepdims=True)
        values = self._critics.run(arrays["features"][None, rows], "learning")
        actions = arrays["actions"][rows].astype(np.int64)
        errors = np.take_along_axis(values[-1][0], actions, 1)
        errors -= arrays["rewards"][rows] + arrays["discounts"][rows] * best
        to_values = np.zeros_like(values[-1])
        # The derivative of the Huber loss is the error, clipped to [-1, 1].
        np.put_along_axis(to_values[0], actions, errors.clip(-1, 1) / np.float32(self._settings.rows), 1)
        self._critics.backpropagate(values, to_values, gradients)
        sizes = np.abs(errors)
        return float(np.where(sizes <= 1, 0.5 * np.square(sizes), sizes - 0.5).sum())


class Td3Gradients(QGradients):
    """Its actor learns from the first critic only; tanh squashes the actions."""

    def __init__(self, arrays: Arrays, settings: QSettings) -> None:
        super().__init__(arrays, settings)
        self._first_critic = self._critics.select(0)

    def _differentiate_critics(self, rows: slice, gradients: list[Floats]) -> float:
        arrays, features = self._arrays, self._arrays["next_features"][rows]
        action = np.tanh(self._target_actor.run(features[None], "target")[-1][0])
        inputs = np.concatenate([features, (action + arrays["noise"][rows]).clip(-1, 1)], 1)
        estimates = self._target_critics.run(inputs[None], "target")[-1].min(0)
        target = arrays["rewards"][rows] + arrays["discounts"][rows] * estimates
        inputs = np.concatenate([arrays["features"][rows], arrays["actions"][rows]], 1)
        values = self._critics.run(inputs[None], "learning")
        errors = values[-1] - target
        self._critics.backpropagate(values, errors * np.float32(2 / self._settings.rows), gradients)
        return float(np.vdot(errors, errors))

    def _differentiate_actor(self, rows: slice, gradients: list[Floats]) -> float:
        features = self._arrays["features"][rows]
        passed = self._actor.run(features[None], "learning")
        action = np.tanh(passed[-1])
        values = self._first_critic.run(np.concatenate([features[None], action], 2), "actor")
        to_value = np.full_like(values[-1], -1 / self._settings.rows)
        to_action = self._first_critic.input_gradient(values, to_value, features.shape[1])
        self._actor.backpropagate(passed, to_action * (1 - np.square(action)), gradients)
        return -float(values[-1].sum())
