"""Elements of the observation that are a copy of the position or the speed of a joint."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from rlctl.checking.world_logs import WorldLog
from rlctl.checking.worlds import JOINTS, Array, Joint, JointKey

EXACT = 2e-6  # relative; the last bits of float32
DEGREES = 180 / math.pi
LEAST_MOTION = 0.02  # standard deviation; calmer joints may be equal by chance [rad], [m], [rad/s], [m/s]


@dataclasses.dataclass(frozen=True)
class JointCopy:
    """An element of the observation that is a joint's position or speed times a factor, plus a constant."""

    column: int
    body: int
    joint: Joint
    is_speed: bool
    factor: float

    @property
    def key(self) -> JointKey:
        """Its joint."""
        return self.body, self.joint.index

    @property
    def name(self) -> str:
        """What it copies, in words."""
        return f"the {'speed' if self.is_speed else 'position'} of joint {self.joint.name}"

    def is_scaled(self, factor: float) -> bool:
        """Say whether it is an angle, or its speed, times a factor."""
        return self.joint.is_angle and math.isclose(abs(self.factor), factor, rel_tol=10 * EXACT)


def find_copies(logs: Sequence[WorldLog], observed: Array) -> list[JointCopy]:
    """Return the elements that are a copy of one value of one joint."""
    copies: dict[int, list[JointCopy]] = {}
    centered = observed - observed.mean(axis=0)
    for i, body in enumerate(logs[0].world.bodies):
        states = np.array([state[i][JOINTS:] for log in logs for state in log.states])
        for number, values in enumerate(states.T):
            is_speed, joint = divmod(number, max(1, len(body.joints)))
            if not np.isfinite(values).all() or values.std() < LEAST_MOTION:
                continue
            feature = values - values.mean()
            factors = feature @ centered / (feature @ feature)
            sizes = np.abs(observed).max(axis=0) + np.abs(factors) * np.abs(values).max()
            off = np.abs(centered - factors * feature[:, None]).max(axis=0)
            for column in np.flatnonzero(
                (off <= EXACT * sizes) & (np.abs(factors) * values.std() > EXACT * sizes * 1e3)
            ):
                copy = JointCopy(int(column), body.id, body.joints[joint], bool(is_speed), float(factors[column]))
                copies.setdefault(copy.column, []).append(copy)
    return [found[0] for _, found in sorted(copies.items()) if len(found) == 1]
