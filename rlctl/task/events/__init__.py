"""Named random changes: domain randomisation, pushes, noise and delay."""

from rlctl.task.events.changes import (
    kick,
    offset_joints,
    push,
    scale_joint_damping,
    scale_mass,
    scale_motor_strength,
    set_color,
    set_contact_stiffness,
    set_friction,
    set_joint_damping,
    shift_gravity,
)
from rlctl.task.events.event import Event, EventSettings, acts_at
from rlctl.task.events.ranges import Fraction, NotNegative, Positive, Range, RangeLimits, Steps
from rlctl.task.events.signals import delay, noise

__all__ = [
    "Event",
    "EventSettings",
    "Fraction",
    "NotNegative",
    "Positive",
    "Range",
    "RangeLimits",
    "Steps",
    "acts_at",
    "delay",
    "kick",
    "noise",
    "offset_joints",
    "push",
    "scale_joint_damping",
    "scale_mass",
    "scale_motor_strength",
    "set_color",
    "set_contact_stiffness",
    "set_friction",
    "set_joint_damping",
    "shift_gravity",
]
