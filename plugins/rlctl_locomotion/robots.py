"""Ant, half-cheetah, hopper, walker and humanoid: the attributes that make each of them of `Locomotion`."""

from collections.abc import Iterable

import numpy as np

from rlctl.task import Box, Event, events
from rlctl_locomotion.locomotion import Locomotion

PLANAR = {
    **Locomotion.rlctl_ignore,
    "RL110": "the family observes sideways speed, heading and roll of robots that cannot leave their plane",
}


def vary(motors: Iterable[str], force: float, link: str | None = None) -> dict[str, Event]:
    """Return the events of all robots, damping [N m s/rad] of joints, and a push of at most `force` [N].

    The models have no damping to scale. A push is a tenth of the robot's weight.
    """
    damping = Event("reset", events.set_joint_damping, body="robot", joints=list(motors), damping=(0.0, 0.5))
    push = Event(
        "interval", events.push, every_s=3.0, body="robot", link=link, force=(0.0, force), duration_s=(0.2, 0.2)
    )
    return {**Locomotion.events, "joint_damping": damping, "push": push}


class Ant(Locomotion):
    """Run on four legs with eight motors; the episode ends when the belly is on the floor."""

    robot = "Ant"
    model = "ant.xml"
    feet = ("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")
    motors = dict.fromkeys((f"{joint}_{leg}" for leg in (1, 2, 3, 4) for joint in ("hip", "ankle")), 2.5 * 100)  # [N m]
    action_space = Box(-1.0, 1.0, (8,), np.float32)
    events = vary(motors, force=180.0)
    rlctl_ignore = {
        **Locomotion.rlctl_ignore,
        "RL804": "the family starts every joint within 0.1 rad of 0, and no ankle can be there",
    }

    def stands(self, height: float, pitch: float) -> bool:
        """The belly is off the floor."""
        return height > 0.26  # [m]; the belly has a radius of 0.25


class HalfCheetah(Locomotion):
    """Run in a vertical plane on two legs with six motors, for as long as the time lasts."""

    robot = "Half-cheetah"
    model = "half_cheetah.xml"
    feet = ("ffoot", "fshin", "fthigh", "bfoot", "bshin", "bthigh")
    motors = {
        "bthigh": 0.9 * 120,
        "bshin": 0.9 * 90,
        "bfoot": 0.9 * 60,
        "fthigh": 0.9 * 140,
        "fshin": 0.9 * 60,
        "ffoot": 0.9 * 30,
    }  # [N m]
    action_space = Box(-1.0, 1.0, (6,), np.float32)
    events = vary(motors, force=37.0, link="torso")
    rlctl_ignore = {**PLANAR, "RL804": "its motors are strong enough to push a foot through the springs at its limits"}

    def stands(self, height: float, pitch: float) -> bool:
        """The pitch is below 1 rad, and only feet touch the floor."""
        _, fshin, fthigh, _, bshin, bthigh = self.last_feet_contact
        return abs(pitch) < 1.0 and not (fshin or fthigh or bshin or bthigh)

    def is_terminated(self) -> bool:
        """Never: not standing costs the bonus, and no more."""
        return False


class Hopper(Locomotion):
    """Hop in a vertical plane on one leg with three motors."""

    robot = "Hopper"
    model = "hopper.xml"
    feet = ("foot",)
    motors = dict.fromkeys(("thigh_joint", "leg_joint", "foot_joint"), 0.75 * 100)  # [N m]
    action_space = Box(-1.0, 1.0, (3,), np.float32)
    events = vary(motors, force=15.0, link="torso")
    rlctl_ignore = PLANAR

    def stands(self, height: float, pitch: float) -> bool:
        """Higher than 0.8 m, the pitch below 1 rad."""
        return height > 0.8 and abs(pitch) < 1.0


class Walker2D(Locomotion):
    """Walk in a vertical plane on two legs with six motors."""

    robot = "Walker"
    model = "walker2d.xml"
    feet = ("foot", "foot_left")
    motors = {
        "thigh_joint": 0.4 * 100,
        "leg_joint": 0.4 * 100,
        "foot_joint": 0.4 * 30,
        "thigh_left_joint": 0.4 * 100,
        "leg_left_joint": 0.4 * 100,
        "foot_left_joint": 0.4 * 30,
    }  # [N m]
    action_space = Box(-1.0, 1.0, (6,), np.float32)
    events = vary(motors, force=23.0, link="torso")
    rlctl_ignore = PLANAR

    def stands(self, height: float, pitch: float) -> bool:
        """Higher than 0.8 m, the pitch below 1 rad."""
        return height > 0.8 and abs(pitch) < 1.0


class Humanoid(Locomotion):
    """Run on two legs with seventeen motors."""

    robot = "Humanoid"
    model = "humanoid_symmetric.xml"
    feet = ("right_foot", "left_foot")
    motors = {
        joint: 0.41 * torque
        for torque, joints in (
            (100, ("abdomen_z", "abdomen_y", "abdomen_x", "right_hip_x", "right_hip_z")),
            (300, ("right_hip_y",)),
            (200, ("right_knee",)),
            (100, ("left_hip_x", "left_hip_z")),
            (300, ("left_hip_y",)),
            (200, ("left_knee",)),
            (75, ("right_shoulder1", "right_shoulder2", "right_elbow")),
            (75, ("left_shoulder1", "left_shoulder2", "left_elbow")),
        )
        for joint in joints
    }  # [N m]
    fast_reset = False  # its limbs touch each other, and such contacts come in another order after a restore
    torque_type = np.float32  # the family rounds the humanoid's torques; another last bit is another fall
    alive_bonus = 2.0  # seventeen noisy motors cost a lot: living must be better than falling
    power_weight, torque_weight = 4.25 * 2.0, 4.25 * 0.1
    action_space = Box(-1.0, 1.0, (17,), np.float32)
    events = vary(motors, force=40.0)

    def reset(self, rng: np.random.Generator) -> None:
        """Start as the others do."""
        super().reset(rng)
        self.start_height = 0.8  # [m]; the torso starts at 1.4, and this is what its observed height is counted from

    def stands(self, height: float, pitch: float) -> bool:
        """Higher than 0.78 m."""
        return height > 0.78
