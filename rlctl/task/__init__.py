"""What a plugin author needs: `Task`, `Sim`, `Body`, `Joints`, `Event`, `TaskError`, reward terms and spaces."""

from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

from rlctl.errors import TaskError
from rlctl.task import events, rewards
from rlctl.task.body import Body
from rlctl.task.constraints import Attachment
from rlctl.task.events import Event
from rlctl.task.motors import Joints
from rlctl.task.sim import Sim
from rlctl.task.task import Task
from rlctl.task.terrain import rough_heights

__all__ = [
    "Attachment",
    "Body",
    "Box",
    "Discrete",
    "Event",
    "Joints",
    "MultiBinary",
    "MultiDiscrete",
    "Sim",
    "Task",
    "TaskError",
    "events",
    "rewards",
    "rough_heights",
]
