"""From what the user typed to an environment: names are listed without importing a plugin, one is loaded.

A task is written as an installed name (`reach`), `package.module:Class`, `path/to/file.py:Class`, or a Gymnasium id
(`Pendulum-v1`, `package:Env-v0`).
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import importlib.util
import inspect
import os
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rlctl.errors import RecipeError, TaskError, UsageError, did_you_mean

if TYPE_CHECKING:
    import gymnasium

GROUP = "rlctl.tasks"
OURS = "rlctl"

_GYMNASIUM_ID = re.compile(r"^(?:[\w.]+:)?(?:[\w.-]+/)?[\w.-]+-v\d+$")


@dataclasses.dataclass(frozen=True)
class TaskEntry:
    """An installed task, as its distribution declares it; nothing of it is imported."""

    name: str
    target: str
    """`package.module:Class`."""
    distribution: str
    version: str
    problem: str | None = None
    """Why it cannot be used under its name, if so."""

    @property
    def module_file(self) -> Path | None:
        """The module's file, found without importing it or its packages."""
        return _module_file(self.target.partition(":")[0])

    @property
    def recipe_file(self) -> Path | None:
        """The packaged recipe: `<name>.yaml` beside the module."""
        file = self.module_file
        return _existing(file.with_name(f"{self.name}.yaml")) if file else None


def installed() -> list[TaskEntry]:
    """Return every installed task, by name; of two with one name the bundled one, or the first, can be used."""
    found: list[TaskEntry] = []
    seen: set[tuple[str, str]] = set()
    for point in importlib.metadata.entry_points(group=GROUP):
        if (point.name, point.value) in seen:  # a checkout on sys.path beside its own installation
            continue
        seen.add((point.name, point.value))
        distribution = (point.dist and point.dist.name) or "?"
        version = (point.dist and point.dist.version) or "?"
        found.append(TaskEntry(point.name, point.value, distribution, version))
    found.sort(key=lambda entry: (entry.name, entry.distribution != OURS, entry.distribution))
    entries: list[TaskEntry] = []
    for entry in found:
        problem = None
        if entries and entries[-1].name == entry.name:
            first = next(e for e in entries if e.name == entry.name)
            problem = f"name taken by {first.distribution}; use {entry.target}"
        elif entry.module_file is None:
            problem = f"module {entry.target.partition(':')[0]!r} is missing"
        entries.append(dataclasses.replace(entry, problem=problem))
    return entries


def find(name: str) -> TaskEntry | None:
    """Return the installed task that a name stands for."""
    return next((entry for entry in installed() if entry.name == name), None)


def check_import(entry: TaskEntry, timeout_s: float = 60.0) -> str | None:
    """Import a task in a child process; return what it raised, in a line, or None."""
    import subprocess

    code = (
        "import sys; sys.path.insert(0, ''); from rlctl import registry; from rlctl.errors import RlctlError\n"
        f"try: registry.load({entry.target!r})\n"
        "except RlctlError as error: print('\\n@' + str(error).splitlines()[0]); sys.exit(3)\n"
        "print('\\n@')"
    )
    try:
        child = subprocess.run(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"import did not end within {timeout_s:.0f} s"
    told = [line[1:] for line in child.stdout.splitlines() if line.startswith("@")]
    if not told:
        return f"import ended the process with exit code {child.returncode}"
    return told[-1] or None


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """Everything an environment is made from; plain data, so it travels to a worker as JSON."""

    task: str
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    reward_weights: Mapping[str, float] = dataclasses.field(default_factory=dict)
    randomize: bool = False
    events: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    frame_stack: int = 1

    def make(self, render_mode: Literal["human", "rgb_array"] | None = None) -> gymnasium.Env[Any, Any]:
        """Build the environment; raises `UsageError` for what the user typed, `TaskError` for what it does."""
        constructor = load(self.task)
        if is_task(constructor):
            env = self._make_task_env(constructor, render_mode)
        else:
            for key in ("reward_weights", "events"):
                if getattr(self, key):
                    raise RecipeError(f"{key}: {self.task} is a plain Gymnasium environment; only tasks have them")
            env = self._make_plain_env(constructor, render_mode)
        if self.frame_stack > 1:
            env = _stack_frames(env, self.frame_stack)
        return env

    def _make_task_env(self, constructor: Any, render_mode: Any) -> gymnasium.Env[Any, Any]:
        from rlctl.task.env import TaskEnv
        from rlctl.task.events import EventSettings

        parameters = _task_parameters(constructor, self.parameters)
        env: gymnasium.Env[Any, Any] = _guarded(
            self.task,
            lambda: TaskEnv(
                constructor(**parameters),
                render_mode=render_mode,
                reward_weights=self.reward_weights,
                events=EventSettings(self.randomize, self.events),
            ),
        )
        return env

    def _make_plain_env(self, constructor: Any, render_mode: Any) -> gymnasium.Env[Any, Any]:
        parameters = dict(self.parameters)
        _check_keywords(self.task, constructor, parameters)
        if render_mode is not None:
            parameters["render_mode"] = render_mode
        env: gymnasium.Env[Any, Any] = _guarded(self.task, lambda: constructor(**parameters))
        if not (hasattr(env, "reset") and hasattr(env, "step") and hasattr(env, "action_space")):
            raise TaskError(f"{self.task}: {type(env).__name__} is no Gymnasium environment (reset, step, spaces)")
        return env


def make(
    task: str, *, render_mode: Literal["human", "rgb_array"] | None = None, **parameters: Any
) -> gymnasium.Env[Any, Any]:
    """Return the Gymnasium environment of a task; keywords are the task's parameters."""
    return EnvSpec(task, parameters).make(render_mode)


def load(task: str) -> Callable[..., Any]:
    """Import what `task` names: a `Task` class, or anything that returns a Gymnasium environment when called."""
    _put_current_folder_on_path()
    if entry := find(task):
        if entry.problem:
            raise TaskError(f"task {task!r} of {entry.distribution} {entry.version}: {entry.problem}")
        return _load_target(task, entry.target)
    if _GYMNASIUM_ID.match(task):
        return _load_gymnasium(task)
    if ":" in task:
        return _load_target(task, task)
    names = [entry.name for entry in installed()]
    raise UsageError(
        f"no task {task!r}.{did_you_mean(task, names)} Installed: {', '.join(dict.fromkeys(names)) or 'none'}. "
        "Other forms: package.module:Class, path/to/file.py:Class, Pendulum-v1."
    )


def is_task(constructor: Any) -> bool:
    """Say whether what was loaded is a `rlctl.task.Task` class."""
    task_module = sys.modules.get("rlctl.task.task")
    return task_module is not None and inspect.isclass(constructor) and issubclass(constructor, task_module.Task)


def recipe_file(task: str) -> Path | None:
    """Return the recipe that comes with a task: `<name>.yaml` beside its module, `<file>.yaml` beside its file."""
    _put_current_folder_on_path()
    if entry := find(task):
        return entry.recipe_file
    if _GYMNASIUM_ID.match(task) or ":" not in task:
        return None
    place = task.rpartition(":")[0]
    file = Path(place) if place.endswith(".py") else _module_file(place)
    return _existing(file.with_suffix(".yaml")) if file else None


def _existing(file: Path) -> Path | None:
    return file if file.is_file() else None


def origin(task: str) -> dict[str, str]:
    """Return what to write down about where a task comes from: `distribution` and `version`, where known."""
    if entry := find(task):
        return {"distribution": entry.distribution, "version": entry.version}
    return {}


def slug(task: str) -> str:
    """Return a folder name for a task: `reach`, `MyEnv`, `Pendulum-v1`."""
    return re.sub(r"[^\w.-]+", "-", task.rpartition(":")[2]).strip("-.") or "task"


def _put_current_folder_on_path() -> None:
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())


def _module_file(module: str) -> Path | None:
    """Find a module's file; unlike `find_spec` on a dotted name this imports no parent package."""
    head, *rest = module.split(".")
    try:
        spec = importlib.util.find_spec(head)
        for depth, _ in enumerate(rest, start=2):
            if spec is None:
                return None
            name = ".".join(module.split(".")[:depth])
            path = spec.submodule_search_locations
            found = (finder.find_spec(name, path) for finder in sys.meta_path if hasattr(finder, "find_spec"))
            spec = next((each for each in found if each is not None), None)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec and spec.origin and spec.has_location else None


def _load_target(task: str, target: str) -> Callable[..., Any]:
    place, _, attribute = target.rpartition(":")
    module = _import_file(task, Path(place)) if place.endswith(".py") else _import_module(task, place)
    constructor = module
    for part in attribute.split("."):
        if not hasattr(constructor, part):
            classes = [name for name, value in vars(module).items() if inspect.isclass(value)]
            own = [name for name in classes if getattr(module, name).__module__ == module.__name__]
            raise UsageError(
                f"{place} has no {attribute!r}.{did_you_mean(attribute, classes)} "
                f"It defines: {', '.join(own) or 'no class'}."
            )
        constructor = getattr(constructor, part)
    if not callable(constructor):
        raise UsageError(f"{target}: {attribute} is a {type(constructor).__name__}, not a class or a function")
    return constructor  # type: ignore[no-any-return]


def _import_module(task: str, name: str) -> Any:
    if _module_file(name) is None and name not in sys.modules:
        raise UsageError(f"task {task!r}: no module {name!r} is installed or under {os.getcwd()}")
    return _guarded(task, lambda: importlib.import_module(name), doing="import failed: ")


def _import_file(task: str, file: Path) -> Any:
    file = file.expanduser().resolve()
    if not file.is_file():
        raise UsageError(f"task {task!r}: no file {file}")
    for loaded, known in list(sys.modules.items()):
        if getattr(known, "__file__", None) == str(file) and loaded != "__main__":
            return known
    folder = str(file.parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    name = file.stem
    while name in sys.modules or name in sys.stdlib_module_names:
        name = f"rlctl_task_{name}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise UsageError(f"task {task!r}: {file} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    loader = spec.loader
    try:
        _guarded(task, lambda: loader.exec_module(module), doing="import failed: ")
    except BaseException:
        sys.modules.pop(name, None)
        raise
    return module


def _load_gymnasium(task: str) -> Callable[..., Any]:
    import gymnasium

    def constructor(**parameters: Any) -> Any:
        try:
            return gymnasium.make(task, disable_env_checker=True, **parameters)
        except gymnasium.error.UnregisteredEnv:
            close = did_you_mean(task.rpartition(":")[2], gymnasium.registry)
            raise UsageError(f"Gymnasium has no environment {task!r}.{close}") from None
        except (ModuleNotFoundError, gymnasium.error.DeprecatedEnv) as error:
            raise UsageError(f"Gymnasium: {task}: {error}") from None

    constructor.gymnasium_id = task  # type: ignore[attr-defined]
    return constructor


def _guarded(task: str, call: Callable[[], Any], doing: str = "") -> Any:
    """Run a plugin's code; whatever it raises, `SystemExit` included, becomes a `TaskError`."""
    from rlctl.errors import RlctlError

    try:
        return call()
    except (RlctlError, KeyboardInterrupt):
        raise
    except BaseException as error:
        where = ""
        frames = traceback.extract_tb(error.__traceback__)
        own = frames and "rlctl" in Path(frames[-1].filename).parts[-2:-1]
        if frames and not own and not frames[-1].filename.startswith("<frozen"):  # a syntax error names its place
            where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})"
        raise TaskError(
            f"task {task!r}: {doing}{type(error).__name__}: {error}{where}", details=traceback.format_exc()
        ) from error


def _check_keywords(task: str, constructor: Any, parameters: Mapping[str, Any]) -> None:
    if hasattr(constructor, "gymnasium_id"):
        import gymnasium
        from gymnasium.envs.registration import load_env_creator

        spec = gymnasium.registry.get(constructor.gymnasium_id)
        if not parameters or spec is None or spec.entry_point is None:
            return
        parameters = {key: value for key, value in parameters.items() if key != "max_episode_steps"}  # of Gymnasium
        entry_point = spec.entry_point
        constructor = entry_point if callable(entry_point) else load_env_creator(entry_point)
    signature = inspect.signature(constructor)
    if any(p.kind is p.VAR_KEYWORD for p in signature.parameters.values()):
        return
    for key in parameters:
        if key not in signature.parameters:
            raise _no_parameter(task, key, list(signature.parameters))


def _no_parameter(task: str, key: str, known: list[str]) -> RecipeError:
    return RecipeError(
        f"task.{key}: {task} has no parameter {key!r}.{did_you_mean(key, known)} It has: {', '.join(known) or 'none'}."
    )


def _task_parameters(task: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Check the parameters of a `Task` against its fields: names and types."""
    import typing

    import pydantic

    fields = task.parameters()
    hints = _guarded(task.__name__, lambda: typing.get_type_hints(task)) if given else {}
    checked = {}
    for key, value in given.items():
        if key not in fields:
            raise _no_parameter(task.__name__, key, list(fields))
        try:
            checked[key] = pydantic.TypeAdapter(hints[key]).validate_python(value)
        except pydantic.ValidationError as error:
            told = error.errors()[0]["msg"].removeprefix("Input ")
            raise RecipeError(f"task.{key}: {told}, got {value!r}") from None
    return checked


def _stack_frames(env: gymnasium.Env[Any, Any], frames: int) -> gymnasium.Env[Any, Any]:
    """Observe the last `frames` observations, oldest first, along the last axis."""
    import numpy as np
    from gymnasium import spaces
    from gymnasium.wrappers import FrameStackObservation, TransformObservation

    space = env.observation_space
    if not isinstance(space, spaces.Box) or len(space.shape) not in (1, 3):
        raise RecipeError(f"frame_stack: only flat and image observations can be stacked, this task has {space}")
    # Gymnasium stacks along a new first axis; networks want vectors and images of the same rank.
    stacked = spaces.Box(
        np.concatenate([space.low] * frames, axis=-1),
        np.concatenate([space.high] * frames, axis=-1),
        dtype=space.dtype.type,
    )
    wrapped = FrameStackObservation(env, frames)
    flat: gymnasium.Env[Any, Any] = TransformObservation(
        wrapped, lambda stack: np.concatenate(list(stack), axis=-1), stacked
    )
    return flat
