"""What a plugin author needs: `Task`, `Sim`, `Body`, `Joints`, `Event`, `TaskError`, reward terms and spaces."""

from gymnasium.spaces import Box as Box
from gymnasium.spaces import Discrete as Discrete
from gymnasium.spaces import MultiBinary as MultiBinary
from gymnasium.spaces import MultiDiscrete as MultiDiscrete

from rlctl.errors import TaskError as TaskError
from rlctl.task import events as events
from rlctl.task import rewards as rewards
from rlctl.task import terms as terms
from rlctl.task.attachments import Attachment as Attachment
from rlctl.task.batch import BatchTask as BatchTask
from rlctl.task.batch import WorldRngs as WorldRngs
from rlctl.task.body import Body as Body
from rlctl.task.camera import Camera as Camera
from rlctl.task.commands import CommandTerm as CommandTerm
from rlctl.task.events import Event as Event
from rlctl.task.joints import Joints as Joints
from rlctl.task.sim import Sim as Sim
from rlctl.task.task import Task as Task
from rlctl.task.terrain import rough_heights as rough_heights
