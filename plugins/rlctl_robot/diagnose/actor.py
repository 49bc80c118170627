"""The policy's action for many logged rows at once, also as a faulty program would compute it."""

import dataclasses

import numpy as np

from rlctl.policy.file import PolicyFile
from rlctl.policy.layers import Activation, Clip, Flatten, Linear, Normalize
from rlctl.policy.network import Network
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.policy import Policy
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


class LoggedPolicy:
    """A policy file that acts on rows of observations, deterministically."""

    def __init__(self, policy: PolicyFile) -> None:
        self._network = network = Network(policy)
        self.info = policy.info
        _, space = policy.info.env.spaces()
        self.low, self.high = (np.ravel(getattr(space, end)).astype(np.float64) for end in ("low", "high"))
        self._layers = [*network.parts.get("", []), *network.trunk, *network.head]
        self.in_rows = network.own is None and network.lstm is None
        self.in_rows = self.in_rows and all(isinstance(layer, _IN_ROWS) for layer in self._layers)
        self._policy = None if self.in_rows else Policy(NumpyActor(policy))
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

    def act(self, observations: Array, variant: Variant = RIGHT) -> Array:
        """Return the actions for observations of shape (rows, elements), shape (rows, actions)."""
        assert self.in_rows  # recurrent and convolutional policies act step by step, see `act_all`
        value = observations
        for layer in self._layers:
            if isinstance(layer, Normalize):
                for _ in range(variant.normalizes):
                    value = layer(value)
            elif isinstance(layer, Linear):
                value = value @ layer.weight.T + layer.bias
            elif not isinstance(layer, Flatten):
                value = layer(value)
        network = self._network
        if not network.is_squashed:
            return np.clip(value, self.low, self.high) if variant.clips else value
        if network.ends_with_tanh and variant.clips:
            value = np.tanh(value)
        return self.low + 0.5 * (value + 1.0) * (self.high - self.low) if variant.unscales else value

    def reset(self) -> None:
        """Begin an episode of a recurrent policy."""
        if self._policy is not None:
            self._policy.reset()

    def act_step(self, observation: Array) -> Array:
        """Return the action for the next observation of an episode, shape (elements,)."""
        if self._policy is None:
            return self.act(observation[None])[0]
        shape = self.info.env.spaces()[0].shape or ()
        return np.ravel(self._policy.predict(observation.astype(np.float32).reshape(shape))).astype(np.float64)

    def act_all(self, signals: LoggedSignals) -> Array:
        """Return the actions for all rows, segment by segment, with a recurrent state that begins with each."""
        if self._policy is None:
            return self.act(signals.observations)
        actions = []
        for start, length in zip(signals.starts, signals.lengths, strict=True):
            self.reset()
            actions += [self.act_step(row) for row in signals.observations[start : start + length]]
        return np.array(actions, np.float64)
