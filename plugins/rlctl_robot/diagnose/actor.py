"""The policy's action for many logged rows at once, also as a faulty program would compute it."""

import dataclasses

import numpy as np

from rlctl.policy.actor import Rows, as_stored
from rlctl.policy.file import PolicyFile
from rlctl.policy.layers import Activation, Clip, Flatten, Linear, Normalize
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.policy import FileActor
from rlctl_robot.diagnose.signals import Array, LoggedSignals

_IN_ROWS = (Linear, Activation, Normalize, Flatten, Clip)


@dataclasses.dataclass(frozen=True)
class Variant:
    """A way in which a program can misuse a policy."""

    text: str
    normalizes: int = 1  # how often observations are normalised
    clips: bool = True
    unscales: bool = True  # from [-1, 1] to the bounds of the action


RIGHT = Variant("")


class LoggedActor(FileActor):
    """A policy file that acts deterministically on the observations of a log; its actions have float64."""

    def __init__(self, policy: PolicyFile) -> None:
        self._actor = NumpyActor(policy)
        self._network = network = self._actor.network
        self.info = policy.info
        _, space = policy.info.env.spaces()
        self.low, self.high = (np.ravel(getattr(space, end)).astype(np.float64) for end in ("low", "high"))
        self._layers = [*network.parts.get("", []), *network.trunk, *network.head]
        self.in_rows = network.own is None and network.lstm is None
        self.in_rows = self.in_rows and all(isinstance(layer, _IN_ROWS) for layer in self._layers)
        self.normalize = next((layer for layer in self._layers if isinstance(layer, Normalize)), None)

    def variants(self) -> list[Variant]:
        """Return the ways to misuse this policy."""
        if not self.in_rows:
            return []
        found = [Variant("the logged actions are those before clipping to the bounds", clips=False)]
        if self.normalize is not None:
            found += [
                Variant("the observations were not normalised before the network", normalizes=0),
                Variant("the observations were normalised twice", normalizes=2),
            ]
        if self._network.is_squashed and not (np.allclose(self.low, -1) and np.allclose(self.high, 1)):
            found.append(Variant("the logged actions are in [-1, 1], not scaled to the bounds", unscales=False))
        return found

    def compute(self, observations: Array, variant: Variant = RIGHT) -> Array:
        """Return the actions for observations of shape (rows, elements), shape (rows, actions).

        Raises `AssertionError` for recurrent and convolutional policies, which act step by step.
        """
        assert self.in_rows
        value = observations
        for layer in self._layers:
            if isinstance(layer, Normalize):
                for _ in range(variant.normalizes):
                    value = layer(value)
            elif not isinstance(layer, Flatten):  # it would round the observations
                value = layer(value)
        network = self._network
        if not network.is_squashed:
            return np.clip(value, self.low, self.high) if variant.clips else value
        if network.ends_with_tanh and variant.clips:
            value = np.tanh(value)
        return self.low + 0.5 * (value + 1.0) * (self.high - self.low) if variant.unscales else value

    def begin(self, rows: Rows) -> None:
        """Begin an episode of a recurrent policy."""
        self._actor.begin(rows)

    def act(self, observations: Array, rows: Rows) -> tuple[Array, Array]:
        """Return the actions for the next observations of episodes, shape (k, elements)."""
        if self.in_rows:
            actions = self.compute(observations)
        else:
            shape = self.info.env.spaces()[0].shape or ()
            seen = observations.astype(np.float32).reshape(len(observations), *shape)
            actions = as_stored(self._actor.act(seen, rows)[1]).astype(np.float64)
        return actions, actions

    def act_on_log(self, signals: LoggedSignals) -> Array:
        """Return the actions for all rows of a log, with a recurrent state that begins with each segment."""
        if self.in_rows:
            return self.compute(signals.observations)
        row, actions = Rows.one(), []
        for start, length in zip(signals.starts, signals.lengths, strict=True):
            self.begin(row)
            actions += [self.act(signals.observations[k : k + 1], row)[0] for k in range(start, start + length)]
        return np.concatenate(actions)
