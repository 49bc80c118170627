"""The inputs of a controller, where a log holds them: what the policy would have observed had they been others."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from rlctl.environments.info import EnvInfo
from rlctl.exporting.controller.observation import ControllerObservation
from rlctl.exporting.controller.plan import ControllerPlan
from rlctl_robot.diagnose.candidates import CONJUGATE, FROM_W_FIRST
from rlctl_robot.diagnose.correction import Correction
from rlctl_robot.diagnose.signals import Array

_W_FIRST = "the quaternion is in the order w, x, y, z, the policy expects x, y, z, w"
_INVERSE = "the quaternion is the conjugate (the inverse rotation)"


@dataclasses.dataclass(frozen=True, eq=False)
class ControllerInputs:
    """The logged inputs of a controller, of which it computes what the policy observes."""

    info: EnvInfo
    sizes: Mapping[str, int]  # elements of each input by name, in the order of the columns
    values: Array  # shape (T, elements)
    actions: Array  # shape (T, actions)
    lengths: tuple[int, ...]  # rows of each segment

    def compute_observations(self, mistake: Correction | None = None) -> Array:
        """Return what the policy observes, shape (T, elements), with a mistake of one of the inputs corrected."""
        ends = np.cumsum(list(self.sizes.values()))[:-1]
        inputs = dict(zip(self.sizes, np.split(self.values, ends, axis=1), strict=True))
        if mistake is not None:
            inputs[mistake.term] = mistake.change(inputs[mistake.term])
        observation, rows = ControllerObservation(ControllerPlan(self.info)), []
        for start, length in zip(np.cumsum([0, *self.lengths[:-1]]).tolist(), self.lengths, strict=True):
            observation.begin()
            for step in range(length):
                row = start + step
                last_action = self.actions[row - 1] if step else np.zeros_like(self.actions[row])
                measured = {name: values[row] for name, values in inputs.items()}
                parts = observation.observe(measured, step, last_action)
                rows.append(np.concatenate([np.ravel(parts[name]) for name in self.info.observation_sizes]))
        return np.array(rows)

    @property
    def quaternions(self) -> list[str]:
        """Names of the inputs that are quaternions (x, y, z, w)."""
        return [part.name for part in ControllerPlan(self.info).quantities if part.unit.startswith("quaternion x")]

    def list_mistakes(self) -> list[Correction]:
        """Return mistakes of inputs that no correction of the computed observations undoes."""
        return [
            mistake
            for name in self.quaternions
            for mistake in (
                Correction(name, "order", _W_FIRST, order=FROM_W_FIRST),
                Correction(name, "sign", _INVERSE, factor=CONJUGATE),
                Correction(name, "order", f"{_W_FIRST}, and {_INVERSE}", order=FROM_W_FIRST, factor=CONJUGATE),
            )
        ]

    def find_sources(self, term: str) -> tuple[str, ...]:
        """Return the inputs from which an observation is computed; empty if the log holds it itself."""
        computed = self.info.observation_terms.get(term)
        return () if term in self.sizes or computed is None else tuple(computed.inputs)
