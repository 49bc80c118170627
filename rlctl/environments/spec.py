"""`EnvSpec`: everything that defines an environment, as plain data; it also builds the environment."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NoReturn

from annotated_types import Ge, Le
from pydantic import AfterValidator, PlainSerializer

from rlctl.engine import PYBULLET, Engine
from rlctl.environments import named_task
from rlctl.environments.graphics import refuse_windows
from rlctl.environments.parameters import check_fields, check_keywords, refuse_unexpected
from rlctl.environments.registry import call_plugin, is_task, load, may_make_environments
from rlctl.errors import RecipeError, TaskError
from rlctl.library_output import print_mujoco_warnings

if TYPE_CHECKING:
    import gymnasium

    from rlctl.environments.gym_worlds import GymWorlds
    from rlctl.task.events import EventSettings
    from rlctl.task.observation import Observing
    from rlctl.task.worlds import TaskWorlds


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """Everything that defines an environment, as plain data.

    Policy files, recorded episodes and messages to workers contain one.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}  # in the models that embed it

    task: str  # as the user wrote it; see `rlctl.environments.registry`
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # keyword arguments of the constructor
    reward_weights: Mapping[str, float] = dataclasses.field(default_factory=dict)  # weights that differ from the task's
    randomize: bool = False  # whether all events of the task act
    events: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    """Events that act, with the parameters that differ from the task's."""
    frame_stack: Annotated[int, Ge(1)] = 1  # number of latest observations that are stacked into one
    time_feature: bool = False  # whether the fraction of the episode that is left is observed
    observe: tuple[str, ...] = ()
    """Names of what the policy observes; empty: all that the task's `observe` returns."""
    observation_history: Mapping[str, Annotated[int, Ge(1)]] = dataclasses.field(default_factory=dict)
    """Numbers of last values by name, which replace the task's own."""
    stage: Annotated[int, Ge(0)] = 0  # stage of the curriculum, from 1; 0 without a curriculum
    level: Annotated[float, Ge(0), Le(1)] = 1.0
    """How far ranges written `{from: ..., to: ...}` have widened, from 0 (`from`) to 1 (`to`)."""
    sim: Engine = Engine()  # noqa: RUF009 (it cannot change)
    """The physics engine of a task; no choice: see `resolve`."""
    named_by: str = dataclasses.field(default="", compare=False)
    """The kind of file that names the task; empty if a user named it. A file may name environments only."""

    def constructor(self) -> Callable[..., Any]:
        """Import the environment's constructor; raises `ArtifactError` if a file names anything else."""
        return named_task.load(self.task, self.named_by) if self.named_by else load(self.task)

    def as_deployed(self) -> EnvSpec:
        """Return the task as a robot has it, with its `deployed_parameters`; a plain environment is unchanged."""
        deployed = getattr(self.constructor(), "deployed_parameters", {})
        return dataclasses.replace(self, parameters={**self.parameters, **deployed}) if deployed else self

    def make(
        self,
        render_mode: Literal["human", "rgb_array", "ansi"] | None = None,
        *,
        teacher: EnvSpec | None = None,
        visuals: bool = True,
    ) -> gymnasium.Env[Any, Any]:
        """Build the environment; raises `UsageError` for wrong names or parameters, `TaskError` if it fails.

        With a `teacher` it also observes what a policy of that spec sees; see `rlctl.environments.teacher_wrapper`.
        Without `visuals` a task that draws nothing needs less memory: see `TaskEnv`.
        """
        constructor = self.constructor()
        print_mujoco_warnings()
        if is_task(constructor):
            env = self._make_task_env(render_mode, visuals=visuals)
        else:
            for key in ("reward_weights", "randomize", "events", "level", "sim", "observation_history"):
                # Files of plain environments that were written before engines could be chosen name PyBullet.
                if getattr(self, key) not in (getattr(EnvSpec(self.task), key), PYBULLET):
                    raise RecipeError(f"{key}: {self.task} is a plain Gymnasium environment; only tasks have them")
            env = self._make_plain_env(constructor, render_mode)
        try:
            if teacher is not None:
                from rlctl.environments.teacher_wrapper import TeacherWrapper

                env = TeacherWrapper(env, teacher.observing, teacher.event_settings, teacher.wrap)
            return self.wrap(env)
        except RecipeError:
            env.close()
            raise

    @property
    def lacks_pybullet(self) -> bool:
        """Whether its engine is PyBullet, which is not installed."""
        from rlctl.task.pybullet.library import is_installed

        return self.sim == PYBULLET and not is_installed()

    def replace_missing_engine(self) -> EnvSpec:
        """Return the spec with the default engine if PyBullet is not installed, as where a policy comes from."""
        return dataclasses.replace(self, sim=Engine()) if self.lacks_pybullet else self

    def wrap(self, env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
        """Return an environment with the wrappers that change its observations; raises `RecipeError`."""
        from rlctl.task.env import TaskEnv

        if self.observe and not isinstance(env.unwrapped, TaskEnv):
            from rlctl.environments.wrappers import select_observations

            env = select_observations(env, self.observe)
        if self.time_feature:
            from rlctl.environments.wrappers import TimeFeature

            env = TimeFeature(env)
        if self.frame_stack > 1:
            from rlctl.environments.wrappers import stack_frames

            env = stack_frames(env, self.frame_stack)
        return env

    def observe_as(self, other: EnvSpec) -> EnvSpec:
        """Return the spec with what another one observes: names, histories, stacked frames, time."""
        names = ("observe", "observation_history", "frame_stack", "time_feature")
        return dataclasses.replace(self, **{name: getattr(other, name) for name in names})

    def resolve(self) -> EnvSpec:
        """Return the spec with its engine: PyBullet if it is installed, for a `BatchTask` and otherwise MuJoCo."""
        if self.sim or not is_task(self.constructor()):
            return self
        from rlctl.task.worlds import choose_engine

        task: Any = self.constructor()
        return dataclasses.replace(self, sim=choose_engine(task))

    @property
    def engine_title(self) -> str:
        """The name of the physics engine, for people; empty for a plain environment. The task is imported."""
        if not is_task(self.constructor()):
            return ""
        return self.resolve().sim.title

    @property
    def event_settings(self) -> EventSettings:
        """Which events act in episodes of a task, and with what values."""
        from rlctl.task.events import EventSettings

        return EventSettings(self.randomize, self.events)

    @property
    def observing(self) -> Observing:
        """What the policy observes of a task."""
        from rlctl.task.observation import Observing

        return Observing(self.observe, self.observation_history)

    @property
    def is_batch(self) -> bool:
        """Whether the task is a `BatchTask`; it is imported."""
        from rlctl.task.batch import BatchTask

        constructor = self.constructor()
        return isinstance(constructor, type) and issubclass(constructor, BatchTask)

    def make_worlds(self, count: int, teacher: EnvSpec | None = None) -> TaskWorlds | GymWorlds:
        """Build so many worlds without visual shapes, one unless the task is a `BatchTask`; raises as `make` does.

        With a `teacher` they also observe what a policy of that spec sees.
        """
        from rlctl.environments.gym_worlds import GymWorlds
        from rlctl.task.worlds import TaskWorlds

        is_wrapped = self.has_wrappers or (teacher is not None and teacher.has_wrappers)
        if self.is_batch and is_wrapped:
            raise RecipeError(f"{self.task} is a BatchTask, whose worlds have no frame_stack and no time_feature")
        if is_wrapped or not is_task(self.constructor()):
            return GymWorlds(self.make(teacher=teacher, visuals=False), self.level)
        print_mujoco_warnings()
        worlds: TaskWorlds = self._build_task(TaskWorlds, count=count, visuals=False)
        worlds.level = self.level
        if teacher is not None:
            worlds.show_teacher(teacher.observing, teacher.event_settings)
        return worlds

    @property
    def has_wrappers(self) -> bool:
        """Whether wrappers around the environment change what is observed."""
        return self.frame_stack > 1 or self.time_feature

    def _build_task(self, build: Callable[..., Any], **options: Any) -> Any:
        """Return what `build` makes of an instance of the task and the settings of this spec."""
        from rlctl.task.task import check_parameters

        constructor: Any = self.constructor()
        check_parameters(constructor)
        parameters = check_fields(constructor, self.parameters)
        settings = {
            "reward_weights": self.reward_weights,
            "events": self.event_settings,
            "sim": self.resolve().sim,
            "observing": self.observing,
        }
        return call_plugin(self.task, lambda: build(constructor(**parameters), **settings, **options))

    def _make_task_env(self, render_mode: Any, *, visuals: bool) -> gymnasium.Env[Any, Any]:
        from rlctl.task.env import TaskEnv

        env: TaskEnv = self._build_task(TaskEnv, render_mode=render_mode, visuals=visuals)
        env.set_level(self.level)
        return env

    def _make_plain_env(self, constructor: Any, render_mode: Any) -> gymnasium.Env[Any, Any]:
        import gymnasium

        from rlctl.task.mujoco.opengl import draw_without_display

        parameters = dict(self.parameters)
        if not may_make_environments(constructor):
            why = "; it was not called, because its source file mentions neither gymnasium nor rlctl"
            hint = f"{why}\nwrite `import gymnasium` in that file"
            self._refuse(constructor, "" if isinstance(constructor, type) else hint)
        check_keywords(self.task, constructor, parameters)
        if render_mode is not None:
            parameters["render_mode"] = render_mode
            try:
                check_keywords(self.task, constructor, parameters)
            except RecipeError:
                raise RecipeError(f"{self.task} takes no render_mode") from None
        draw_without_display(only_where_possible=True)  # a constructor may draw, in any render mode
        try:
            with refuse_windows(self.task):
                env: gymnasium.Env[Any, Any] = call_plugin(self.task, lambda: constructor(**parameters))
        except TaskError as error:
            refuse_unexpected(self.task, constructor, self.parameters, error.__cause__)
            raise
        asking = "__getattr__ for an attribute that it lacks: "  # which must raise AttributeError
        is_vectorised = call_plugin(self.task, lambda: hasattr(env, "num_envs"), doing=asking)
        if is_vectorised and not isinstance(env, gymnasium.Env):
            hint = "give a single environment; rlctl itself runs n_envs of them in parallel"
            raise TaskError(f"{self.task}: {type(env).__name__} is a vectorised environment\n{hint}")
        if not (hasattr(env, "reset") and hasattr(env, "step") and hasattr(env, "action_space")):
            self._refuse(type(env))
        return env

    def _refuse(self, what: Any, hint: str = "") -> NoReturn:
        name = getattr(what, "__name__", what)
        expected = "neither a Gymnasium environment (reset, step, spaces) nor a subclass of rlctl.task.Task"
        raise TaskError(f"{self.task}: {name} is {expected}{hint}")


@dataclasses.dataclass(frozen=True)
class EnvChanges:
    """Changes that `--set` makes to the environment of a policy or a recipe."""

    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    reward_weights: Mapping[str, float] = dataclasses.field(default_factory=dict)
    randomize: bool | None = None
    """True: all events act. False: only those in `events`, and those the task enables itself. None: unchanged."""
    events: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    sim: Engine = Engine()  # noqa: RUF009 (it cannot change)
    """Physics engine; no choice: unchanged."""

    def apply(self, spec: EnvSpec) -> EnvSpec:
        """Return `spec` with the changes applied."""
        return dataclasses.replace(
            spec,
            parameters=merge(spec.parameters, self.parameters),
            reward_weights=merge(spec.reward_weights, self.reward_weights),
            randomize=spec.randomize if self.randomize is None else self.randomize,
            events=merge({} if self.randomize is False else spec.events, self.events),
            sim=self.sim or spec.sim,
        )

    def __bool__(self) -> bool:
        return self != UNCHANGED


UNCHANGED = EnvChanges()


def merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Return `below` updated with `above`; nested mappings are merged too."""
    result = dict(below)
    for key, value in above.items():
        known = result.get(key)
        both = isinstance(known, Mapping) and isinstance(value, Mapping)
        result[key] = merge(known, value) if both else value  # type: ignore[arg-type]
    return result


def _name_by(kind: str) -> Callable[[EnvSpec], EnvSpec]:
    return lambda spec: dataclasses.replace(spec, named_by=kind)


def _dump(spec: EnvSpec) -> dict[str, Any]:
    content = dataclasses.asdict(spec) | {"sim": str(spec.sim)}
    del content["named_by"]
    return content


PolicySpec = Annotated[EnvSpec, AfterValidator(_name_by(named_task.POLICY)), PlainSerializer(_dump)]
"""The `EnvSpec` in a policy file; the file may come from somebody else, so its task is checked before the import."""
EpisodeSpec = Annotated[EnvSpec, AfterValidator(_name_by(named_task.EPISODE)), PlainSerializer(_dump)]
"""The `EnvSpec` in a recorded episode."""
