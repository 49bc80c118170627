"""Named random changes: domain randomisation, pushes, noise and delay."""

from rlctl.task.events.changes import delay as delay
from rlctl.task.events.changes import kick as kick
from rlctl.task.events.changes import lock_joints as lock_joints
from rlctl.task.events.changes import noise as noise
from rlctl.task.events.changes import offset_joints as offset_joints
from rlctl.task.events.changes import push as push
from rlctl.task.events.changes import scale_joint_damping as scale_joint_damping
from rlctl.task.events.changes import scale_mass as scale_mass
from rlctl.task.events.changes import scale_motor_strength as scale_motor_strength
from rlctl.task.events.changes import set_color as set_color
from rlctl.task.events.changes import set_contact_stiffness as set_contact_stiffness
from rlctl.task.events.changes import set_friction as set_friction
from rlctl.task.events.changes import set_joint_damping as set_joint_damping
from rlctl.task.events.changes import shift_gravity as shift_gravity
from rlctl.task.events.event import Event as Event
from rlctl.task.events.event import EventSettings as EventSettings
from rlctl.task.events.event import Fraction as Fraction
from rlctl.task.events.event import NotNegative as NotNegative
from rlctl.task.events.event import Positive as Positive
from rlctl.task.events.event import Range as Range
from rlctl.task.events.event import RangeLimits as RangeLimits
from rlctl.task.events.event import Steps as Steps
from rlctl.task.events.event import acts_at as acts_at
