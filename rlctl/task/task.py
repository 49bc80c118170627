"""`Task`: what a plugin author writes, and the definition that it shares with `BatchTask`."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.errors import TaskError
from rlctl.task.camera import Camera, check_cameras
from rlctl.task.commands import CommandTerm
from rlctl.task.events import Event
from rlctl.task.history import HistoryStart
from rlctl.task.joints import Joints
from rlctl.task.mirror import Declaration
from rlctl.task.sim import Sim
from rlctl.task.terms import Term

LONGEST_HISTORY = 1000  # [steps]


class TaskDefinition:
    """What a `Task` and a `BatchTask` share: the definition of a robot-learning problem.

    Subclass one of them as a dataclass. Annotated fields are the task's parameters (`--set task.tolerance=0.02`);
    the attributes below are its definition and are assigned without an annotation.
    """

    robot: Any = ""
    """Name of the robot, as text in the class. An instance may call its body `self.robot`."""
    control_dt: ClassVar[float] = 1 / 60
    """Time between two actions [s]."""
    substeps: ClassVar[int] = 4
    """Physics steps per action; each takes `control_dt / substeps`."""
    solver_iterations: ClassVar[int] = 50
    episode_s: float = 5.0
    """Time limit of an episode [s]; reaching it truncates, never terminates. An annotation makes it a parameter."""
    action_space: ClassVar[spaces.Space[Any]]
    action_meaning: ClassVar[str] = ""
    observation_layout: ClassVar[Literal["flat", "dict"]] = "flat"
    """One flat Box in the order of `observe`, or a Dict space with one entry per name."""
    observation_terms: ClassVar[Mapping[str, Term]] = {}
    """Observations that are computed from measured quantities, by name; see `rlctl.task.terms`."""
    observation_history: ClassVar[Mapping[str, int]] = {}
    """Number of last values that an observation consists of, oldest first, by name; other observations have one."""
    history_start: ClassVar[HistoryStart] = "first"
    """What fills histories when an episode begins: `first`, the first observation, or `zeros`."""
    observation_units: ClassVar[Mapping[str, str]] = {}
    """Unit by name, also of the quantities of `observation_terms`."""
    observation_bounds: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Range per observation name, in its unit; other observations are unbounded."""
    cameras: ClassVar[Mapping[str, Camera]] = {}
    """Cameras whose pictures a policy may observe: it names them in the recipe's key `observe`, and they are drawn only
    then. The observation is a Dict space with one entry per name."""
    reward_weights: ClassVar[Mapping[str, float]] = {}
    """Weight per reward term; a term with weight 0 is a metric."""
    deployed_parameters: ClassVar[Mapping[str, Any]] = {}
    """Parameters of the task as a robot has it, such as `{"random_start": False}`: a controller's clock begins at 0.

    Exports are verified with them, and `rlctl robot`, `play`, `diagnose` and `--policy reference` use them.
    """
    mirror: ClassVar[Declaration] = {}
    """How the robot's mirror image, left and right exchanged, is observed and acts: per observation, and for `action`,
    which element is each element of the mirrored array, counted from 1, with its sign: `{"gyroscope": (-1, 2, -3)}`.
    The recipe's key `mirror` uses it. Names of `privileged`, and `events/NAME`, may have an entry too."""
    events: ClassVar[Mapping[str, Event]] = {}
    stages: ClassVar[Sequence[Mapping[str, Any]]] = ()
    """Stages of a curriculum, such as `{"task": {"tolerance": 0.2}, "promote": {"success": 0.8, "window": 100}}`; the
    last one, often `{}`, is the task that is evaluated. The recipe's key `stages` replaces them."""
    fast_reset: ClassVar[bool] = True
    """Reset by restoring the built world. False loads the world again at every reset, which is a hundred times slower:
    for worlds whose contacts do not repeat bit for bit after a restore."""

    level: Any = 1.0
    """How hard the episode is that `reset` begins, from 0 to 1: the `level` of the curriculum's stage, 1 without one.
    For a `BatchTask` an array of shape (worlds,)."""
    sim: Sim
    """The simulation this task was built in; set before `build`."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        own = {name for name, hint in TaskDefinition.__annotations__.items() if "ClassVar" in str(hint)}
        definition = {"robot"} | own
        for name, hint in cls.__dict__.get("__annotations__", {}).items():
            if name in definition and "ClassVar" not in str(hint):
                raise TaskError(
                    f"{cls.__name__}.{name} is annotated, which would make it a parameter: "
                    f"write `{name} = ...` without the annotation"
                )

    def build(self, sim: Sim) -> None:
        """Load the bodies into `sim`. Called once; the world is saved after it."""
        raise NotImplementedError

    def describe_joints(self) -> Joints | None:
        """Return the joints that the action moves, in the action's order, for controllers of the real robot. Optional.

        Called once, after `build`. Leave out unknown values; `Body.describe_joints` reads the limits.
        """
        return None

    @classmethod
    def parameters(cls) -> dict[str, dataclasses.Field[Any]]:
        """Return the constructor's parameters by name."""
        if not dataclasses.is_dataclass(cls):
            return {}
        return {field.name: field for field in dataclasses.fields(cls) if field.init}

    @property
    def max_steps(self) -> int:
        """Steps until the time limit."""
        return max(1, round(self.episode_s / self.control_dt))


class Task(TaskDefinition):
    """One robot-learning problem: a world, what is observed, what is rewarded; see `TaskDefinition`."""

    def reset(self, rng: np.random.Generator) -> None:
        """Start an episode in the restored world; take all random numbers from `rng`."""

    def act(self, action: NDArray[Any]) -> None:
        """Set motor targets from an action that is inside `action_space`."""
        raise NotImplementedError

    def observe(self) -> dict[str, Any]:
        """Return what the policy sees, by name; the observation has the same order."""
        raise NotImplementedError

    def rewards(self, action: NDArray[Any]) -> dict[str, float]:
        """Return the raw reward terms, by the names of `reward_weights`."""
        raise NotImplementedError

    def is_success(self) -> bool | None:
        """Return whether the goal is reached now; an episode succeeds if it is reached at its end. Optional."""
        return None

    def is_terminated(self) -> bool:
        """Return whether the episode ends, for example after a fall; the time limit is not part of it. Optional."""
        return False

    def privileged(self) -> dict[str, NDArray[np.float64]]:
        """Return what only a critic sees, by name, such as the true velocity or the friction of the ground. Optional.

        Called after `observe` in a training whose recipe has the key `privileged`, and nowhere else: policies, players
        and exported files never see it.
        """
        return {}

    def compute_reward(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any) -> NDArray[Any]:
        """Return the rewards, shape (n,), of steps for other desired goals; goals have shape (n, size). Optional.

        Hindsight replay (`her` in a recipe) needs it. Observe `observation`, `achieved_goal` and `desired_goal` in
        the layout "dict". The result is the weighted sum of `rewards`, computed from the goals only: `info` is empty.
        Compute along the last axis, so that one pair of goals, shape (size,), gives one number.
        """
        raise NotImplementedError

    def markers(self) -> dict[str, NDArray[np.float64]]:
        """Return points to draw, such as the goal: name -> world position of shape (3,) [m]. Optional."""
        return {}

    def commands(self) -> dict[str, CommandTerm]:
        """Return what a person may command in `rlctl play`, by name, in the order of the keys. Optional."""
        return {}

    def set_commands(self, values: Mapping[str, float]) -> None:
        """Set some of the `commands`, within their ranges; `reset` may draw others."""
        raise NotImplementedError


def check_parameters(task: type[TaskDefinition]) -> None:
    """Raise `TaskError` for a class with annotated values that is not a dataclass."""
    for cls in task.__mro__[: task.__mro__.index(TaskDefinition)]:
        hints = {key: hint for key, hint in cls.__dict__.get("__annotations__", {}).items() if key in cls.__dict__}
        parameters = [key for key, hint in hints.items() if "ClassVar" not in str(hint)]
        if parameters and "__dataclass_fields__" not in cls.__dict__:
            raise TaskError(
                f"{cls.__name__} has parameters ({', '.join(parameters)}) but is not a dataclass: "
                "write @dataclass in the line above the class"
            )


_CONTRACTS = ("rlctl.task.task", "rlctl.task.batch")  # whose methods an author's class defines


def check_definition(task: TaskDefinition) -> None:
    """Raise `TaskError` for an invalid attribute of a task, and for a missing method."""
    name, required = type(task).__name__, ("build", "act", "observe", "rewards")
    owners = {method: next(cls for cls in type(task).__mro__ if method in vars(cls)) for method in required}
    missing = [f"{method}()" for method, cls in owners.items() if cls.__module__ in _CONTRACTS]
    if missing:
        raise TaskError(f"{name} does not define {', '.join(missing)}; a task needs {', '.join(required)}")
    if not isinstance(getattr(task, "action_space", None), spaces.Space):
        raise TaskError(f"{name} does not define action_space: Box(-1.0, 1.0, (7,), np.float32), for example")
    for key in ("control_dt", "episode_s"):
        if not 0 < (seconds := getattr(task, key)) < math.inf:
            raise TaskError(f"{name}: {key} is {seconds}; it must be a time above 0 [s]")
    if task.control_dt > task.episode_s:
        raise TaskError(f"{name}: control_dt is {task.control_dt} s, longer than an episode of {task.episode_s} s")
    for key in ("substeps", "solver_iterations"):
        if not isinstance(count := getattr(task, key), int) or count < 1:
            raise TaskError(f"{name}: {key} is {count}; it must be a whole number, at least 1")
    if (layout := task.observation_layout) not in ("flat", "dict"):
        raise TaskError(f"{name}: observation_layout is {layout!r}; it must be 'flat' or 'dict'")
    for key in ("robot", "action_meaning"):
        if not isinstance(text := getattr(type(task), key), str):
            raise TaskError(f"{name}: {key} of the class is {text!r}; it must be text")
    for key, unit in task.observation_units.items():
        if not isinstance(key, str) or not isinstance(unit, str):
            raise TaskError(f"{name}: observation_units has {key!r}: {unit!r}; both must be text")
    for key, bounds in task.observation_bounds.items():
        if np.shape(bounds) != (2,) or not bounds[0] <= bounds[1]:
            raise TaskError(
                f"{name}: observation_bounds of {key!r} are {bounds}; they must be two numbers, (low, high)"
            )
    for key, term in task.observation_terms.items():
        if not isinstance(term, Term):
            raise TaskError(f"{name}: observation_terms of {key!r} is {term!r}; it must be one of rlctl.task.terms")
    for key, count in task.observation_history.items():
        if not isinstance(count, int) or not 1 <= count <= LONGEST_HISTORY:
            raise TaskError(
                f"{name}: observation_history of {key!r} is {count!r}; it must be a number of steps, "
                f"from 1 to {LONGEST_HISTORY}"
            )
    if task.history_start not in ("first", "zeros"):
        raise TaskError(f"{name}: history_start is {task.history_start!r}; it must be 'first' or 'zeros'")
    check_cameras(name, task.cameras)
    for key, event in task.events.items():
        if not isinstance(event, Event):
            raise TaskError(f"{name}: events.{key} is not an Event: Event('reset', scale_mass, body=...), for example")
