"""What a body in MuJoCo needs of the `Sim` that it is in: `MujocoSim`, or one world of it."""

from collections.abc import Mapping
from typing import Any, Protocol

from rlctl.task.body import Array
from rlctl.task.motors import Motor
from rlctl.task.mujoco.world import Fields, MujocoWorld


class BodyOwner(Protocol):
    """A `MujocoSim`, for its bodies."""

    mujoco: Any
    world: MujocoWorld
    fields: Fields
    _control_dt: float
    _pair_links: Array

    @property
    def model(self) -> Any:
        """MuJoCo's `MjModel`, as it was built."""

    @property
    def data(self) -> Any:
        """MuJoCo's `MjData` of a single world."""

    def add_force_sensor(self, joint: str, link: str) -> None:
        """Measure the force in a joint."""

    def add_contact_sensor(self, link: str) -> None:
        """Count the contacts of a link."""

    def add_motors(self, body: str, motors: Mapping[str, Motor]) -> None:
        """Make motors of a body real ones, by joint."""

    def spread_friction(self) -> None:
        """Give every pair of links its friction again."""
