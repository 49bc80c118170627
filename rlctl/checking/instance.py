"""Instances of an untrusted environment: how they are called, and what a call raised, as plain data."""

import ast
import contextlib
import dataclasses
import functools
import inspect
import linecache
import math
import random
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Literal

import gymnasium
import numpy as np

from rlctl.checking.progress import CallProgress, read_clock
from rlctl.checking.records import CallFailure
from rlctl.checking.rule import NotJudged
from rlctl.checking.values import is_task
from rlctl.environments import registry
from rlctl.environments.bullet_clients import find_clients
from rlctl.environments.graphics import opengl_fix
from rlctl.environments.leaves import find_leaves
from rlctl.environments.mujoco_version import mujoco_fix
from rlctl.environments.places import find_line, format_place, is_own_file
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RlctlError, TaskError, name_kind, read_message
from rlctl.missing_packages import advise
from rlctl.version import PACKAGE_FOLDER

_HERE = Path(__file__).parent
NO_DISPLAY = re.compile(
    r"cannot connect to x server|could ?n.t connect to display|could not connect to display|no \$DISPLAY|"
    r"DISPLAY environment variable is missing|no available video device|cannot open display|"
    r"could not load the qt platform plugin|NoSuchDisplayException|failed to open display",
    re.IGNORECASE,
)
"""What X11, PyBullet, GLFW, pygame, Qt, Tk and pyglet print where there is no display."""
_NO_FILE = re.compile(r"Error opening file '([^']+)'|^File (.+) does not exist$")
"""What MuJoCo's ValueError says, and the OSError of Gymnasium's MujocoEnv."""
_MODELS = {".xml", ".mjcf", ".mjb", ".urdf"}  # other files are named in these
_MODEL = re.compile(r"[^\n]+\.(urdf|sdf|xml|mjcf|obj|stl|dae|vtk|png|jpg|bullet)", re.IGNORECASE)


class EnvironmentRaised(Exception):
    """A call into the environment raised an exception, its cause."""

    def __init__(self, call: str, cause: BaseException) -> None:
        super().__init__(call)
        self.call, self.cause = call, cause

    def __str__(self) -> str:
        return describe(self.cause)


def describe_failure(error: EnvironmentRaised, progress: CallProgress) -> CallFailure:
    """Describe what a call into the environment raised, and when."""
    at, cause = progress.read(), error.cause
    place = (error.call, at.phase, at.episode, at.seed, at.step)
    trace, file = "".join(traceback.format_exception(cause)), find_missing_file(cause)
    text = describe(cause)
    fix = opengl_fix(text) or mujoco_fix(cause) or warning_fix(cause)
    return CallFailure("raised", *place, text, trace, file, find_line(cause), fix=fix)


def raised_by_environment(error: BaseException) -> bool:
    """Return whether an exception comes from code of the environment, such as a property or `__getattr__`.

    Libraries between that code and the place of the exception do not matter.
    """
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if is_own_file(frame.filename):
            return True
        if PACKAGE_FOLDER in Path(frame.filename).parents:
            return False
    return False


def describe(error: BaseException) -> str:
    """Return an exception in a line, with the place in the environment's code."""
    if isinstance(error, RlctlError):  # of the task layer, which names the task and the step itself
        return f"{name_kind(error)}: {error}"
    where = find_line(error)
    place = f" ({format_place(*where)})" if where else ""
    text = " ".join(read_message(error).split()) or "no message"
    return f"{name_kind(error)}: {text}{place}{advise(error)}"


def warning_fix(error: BaseException) -> str:
    """Return what to do about a warning that a filter makes an exception; empty for other exceptions."""
    cause = 'an imported package calls warnings.filterwarnings("error"), or Python runs with -W error'
    return f"It is a warning that a filter makes an exception: {cause}." if isinstance(error, Warning) else ""


def display_error(failure: CallFailure) -> str:
    """Return the line that a process printed which ended because it has no display; empty for other failures."""
    lines = (failure.details or "").splitlines() if failure.kind == "died" else []
    return next((line.strip() for line in lines if NO_DISPLAY.search(line)), "")


def lacks_display(error: str) -> bool:
    """Say whether an exception says that a window cannot be opened; one about OpenGL may come from a picture."""
    return bool(NO_DISPLAY.search(error)) and not opengl_fix(error)


def find_missing_file(error: BaseException | None) -> dict[str, Any] | None:
    """Describe the file behind an exception, or behind what caused it; None if it is about something else."""
    for cause in get_causes(error):
        message = read_message(cause)
        name, folders = None, [str(Path.cwd())]
        if isinstance(cause, FileNotFoundError):
            path = re.search(r"[^\s'\"]*[/\\][^\s'\":]*", message)
            name = str(cause.filename or (path[0] if path else message))
        elif match := _NO_FILE.search(message):
            name = match[1] or match[2]
            if Path(name).suffix.lower() not in _MODELS:
                folders = ["the folder of the model, or that of its meshdir or texturedir"]
        elif type(cause).__module__ == "pybullet" and "load" in message.lower():
            name, data = _find_model(cause.__traceback__), sys.modules.get("pybullet_data")
            folders += [data.getDataPath()] if data else []
        if name is not None:
            searched = [] if Path(name).is_absolute() else folders
            found = next((folder for folder in searched[1:] if Path(folder, name).is_file()), "")
            return {"file": name, "searched": searched, "found": found}
    return None


def find_first_error(error: BaseException | None) -> BaseException | None:
    """Return the first exception of the chain that a traceback of this one shows; None if it is the only one."""
    first = error
    while first is not None:
        behind = first.__cause__
        if behind is None and not first.__suppress_context__:
            behind = first.__context__
        if behind is None:
            break
        first = behind
    return None if first is error else first


def get_causes(error: BaseException | None) -> list[BaseException]:
    """Return an exception and those behind it."""
    return [] if error is None else [error, *get_causes(error.__cause__ or error.__context__)]


def _find_model(trace: TracebackType | None) -> str | None:
    """Return the model that the failing call was given; None if that is not known."""
    calls = list(zip(traceback.walk_tb(trace), traceback.extract_tb(trace), strict=True))
    calls = [pair for pair in calls if _HERE not in Path(pair[1].filename).parents]
    if not calls:
        return None
    (frame, _), summary = calls[-1]
    lines = linecache.getlines(summary.filename)[(summary.lineno or 1) - 1 : summary.end_lineno]
    if lines and summary.end_colno is not None and summary.colno is not None:
        lines[-1] = lines[-1].encode()[: summary.end_colno].decode()
        lines[0] = lines[0].encode()[summary.colno :].decode()
    try:
        nodes = list(ast.walk(ast.parse("".join(lines).strip())))
    except SyntaxError:
        return None
    texts = [_evaluate(node, frame) for node in nodes]  # an expression before the texts that it is made of
    return next((text for text in texts if text and _MODEL.fullmatch(text) and not Path(text).is_file()), None)


def _evaluate(node: ast.AST, frame: FrameType) -> str | None:
    """Return the text that an expression of a frame has; None if it is none, or only code could tell."""
    parts: list[str | None]
    match node:
        case ast.Constant(value=value):
            return value if isinstance(value, str) else None
        case ast.Name() | ast.Attribute():
            root, *attributes = ast.unparse(node).split(".")
            value = frame.f_locals.get(root, frame.f_globals.get(root))
            for attribute in attributes:
                value = inspect.getattr_static(value, attribute, None)  # runs no code of the environment
            return str(value) if isinstance(value, (str, Path)) else None
        case ast.FormattedValue(value=value):
            return _evaluate(value, frame)
        case ast.JoinedStr(values=values):
            parts, separator = [_evaluate(value, frame) for value in values], ""
        case ast.BinOp(left=left, right=right, op=ast.Add() | ast.Div() as op):
            parts, separator = [_evaluate(value, frame) for value in (left, right)], "/" * isinstance(op, ast.Div)
        case ast.Call(func=ast.Attribute(attr="join"), args=arguments):  # of os.path
            parts, separator = [_evaluate(value, frame) for value in arguments], "/"
        case _:
            return None
    return None if None in parts else separator.join(part for part in parts if part is not None)


Timer = Callable[..., Any]  # calls its first argument with the others

MOST_STEPS, MOST_RESETS, RESERVE = 14_000, 200, 1.3  # Of all experiments of a process, about; for what is not a step
MOST_FAILURES = 3  # An experiment stops after so many episodes that raised


@dataclasses.dataclass
class Budget:
    """What the episodes of an experiment may use together."""

    deadline: float  # On `read_clock`'s clock [s]
    last: float = math.inf  # when the time of the whole process is over: no call begins after it
    began: float = 0.0
    growth: Callable[[], float] = lambda: 1.0
    """How many times longer it lasts than was known when it began: an environment shows while it is played how slow it
    is."""
    bytes_left: int = 48 * 2**20
    failures: int = 0
    was_cut: bool = False  # whether time ran out before all steps or resets were done

    @property
    def seconds_left(self) -> float:
        """How much time is left [s]."""
        return max(0.0, self.ends(self.deadline) - read_clock())

    def ends(self, planned: float) -> float:
        """Return when something ends that was planned to end at a time."""
        growth = self.growth()
        return planned if growth == 1.0 else self.began + (planned - self.began) * growth

    def is_over(self) -> bool:
        """Say whether time ran out, and note it: the caller then stops the experiment."""
        is_over = read_clock() > self.ends(self.deadline)
        self.was_cut |= is_over
        return is_over

    def require_time(self, least_s: float = 0.0) -> None:
        """Raise `NotJudged` if the time of the whole process is over in `least_s`."""
        if read_clock() + least_s > self.ends(self.last):
            self.was_cut = True
            raise NotJudged("time ran out")

    def why_spent(self) -> str:
        """Return which resource is used up; empty if none is."""
        if self.failures >= MOST_FAILURES:
            return f"{self.failures} of them raised"
        if self.bytes_left <= 0:
            return "memory was used up"
        return "time ran out" if self.is_over() else ""


class Instance:
    """One environment, and how it is called."""

    def __init__(self, env: Any, context: "Context", connected: frozenset[int] = frozenset()) -> None:
        """`connected` are the clients of PyBullet that it connected when it was built. Raises `TaskError` where its
        observation space cannot be read."""
        try:
            self.leaves = find_leaves(getattr(env, "observation_space", None))
        except Exception as error:
            raise TaskError(f"observation_space raises {describe(error)}") from error
        self.env = env
        self.action_leaves = find_leaves(getattr(env, "action_space", None))
        self.accepts_seed, self.accepts_options = (_accepts(env, name) for name in ("seed", "options"))
        self.context = context
        self.connected = connected
        self.progress = context.progress
        self.timers: Mapping[str, Timer] = {}  # by the name of the call they time
        self.resets = 0  # how often it was reset

    @property
    def max_steps(self) -> int | None:
        """The longest episode that it declares [steps]; None where it declares none."""
        from rlctl.environments.wrappers import find_time_limit

        return int(self.env.unwrapped.max_steps) if is_task(self.env) else find_time_limit(self.env)

    def find_clients(self) -> list[int]:
        """Return its clients of PyBullet: those that no other instance connected; all of them if none is left."""
        clients, others = find_clients(), self.context.connected - self.connected
        return [client for client in clients if client not in others] or clients

    def call(self, name: str, function: Any, *arguments: Any, step: int = 0, **keywords: Any) -> Any:
        """Call into the environment; whatever it raises, `SystemExit` included, is an `EnvironmentRaised`.

        Raises `NotJudged` where the time of the process is over.
        """
        if name != "close":
            self.context.budget.require_time()
        self.progress.enter(name, step)
        try:
            if timer := self.timers.get(name):
                return timer(function, *arguments, **keywords)
            return function(*arguments, **keywords)
        except BaseException as error:
            raise EnvironmentRaised(name, error) from error
        finally:
            self.progress.leave()

    def reset(self, seed: int, episode: int = 0) -> Any:
        """Reset with a seed, where reset takes one, and return what it returns."""
        self.resets += 1
        self.progress.episode(episode, seed)
        keywords = {"seed": seed} if self.accepts_seed else {}
        if self.context.seeds_globals:
            random.seed(seed)
            np.random.seed(seed)  # noqa: NPY002 (the environment's own draws)
        return self.call("reset", self.env.reset, **keywords)

    def close(self) -> list[CallFailure]:
        """Close the environment, where it can be; return what that raised."""
        try:
            self.call("close", getattr(self.env, "close", lambda: None))
        except EnvironmentRaised as error:
            return [describe_failure(error, self.progress)]
        finally:
            self.context.connected.intersection_update(find_clients())  # others may get the ids of these
        return []


class Context:
    """One child process's view of the environment."""

    def __init__(self, spec: EnvSpec, progress: CallProgress | None = None) -> None:
        self.spec = spec
        self.progress = progress or CallProgress()
        self.budget = Budget(read_clock())  # What the experiment that is running may use
        self.least_s = 0.0  # what the last build took: an experiment takes at least so long
        self.most_growth = 1.0  # how many times longer a slow environment may be checked
        self.seconds = math.inf  # what all experiments of the process may take together
        self.unseeded_calls: set[tuple[str, int]] = set()  # file and line of default_rng() in reset or step
        self.longest_episode: int | None = None  # of the whole episodes [steps]; None before there are any
        self.reached_limit = False  # whether one of them was truncated
        self.generators: dict[str, str] | None = None  # State of each after the first watched reset; None before
        self.seeds_globals = False
        """Whether a reset seeds `numpy.random` and `random`, too. An environment that draws from them plays another
        episode after each reset, which is RL301 and RL309; other rules can judge it all the same."""
        self.connected: set[int] = set()
        """The clients of PyBullet that instances connected when they were built. Those that do not close them, or are
        not closed, leave their worlds beside those of the kept instance."""

    def note_episode(self, steps: int, ended: str) -> None:
        """Note how long an episode of the kept instance lasted, and how it ended."""
        self.longest_episode = max(self.longest_episode or 0, steps)
        self.reached_limit |= ended in ("truncated", "both")

    def build(self, render_mode: Literal["rgb_array"] | None = None, spec: EnvSpec | None = None) -> Instance:
        """Return a new instance; what its import or constructor raises is an `EnvironmentRaised`."""
        self.budget.require_time(self.least_s)
        try:
            # Loaded before it is built, to distinguish an import error from a constructor's.
            self.progress.enter("load")
            registry.load(self.spec.task)
            older = find_clients()
            self.progress.enter("build")
            began = read_clock()
            env = (spec or self.spec).make(render_mode)
            self.least_s = read_clock() - began
            self.progress.leave()
            connected = frozenset(find_clients()).difference(older)
            self.connected |= connected
            return Instance(env, self, connected)
        except BaseException as error:
            raise EnvironmentRaised("build", error) from error

    @property
    def needed_s(self) -> float:
        """Estimate how long all experiments of a process take [s]; 0 before it is known how slow the steps are."""
        step_s, reset_s = self.progress.mean_s("step"), self.progress.mean_s("reset", fewest=2)
        return RESERVE * (MOST_STEPS * (step_s or 0.0) + MOST_RESETS * (reset_s or 0.0))

    @property
    def growth(self) -> float:
        """How many times longer than `seconds` the experiments may take, because the environment is slow."""
        return min(max(self.needed_s / self.seconds, 1.0), self.most_growth)

    @functools.cached_property
    def instance(self) -> Instance:
        """The instance that this process keeps; built by its first use."""
        return self.build()

    @property
    def is_built(self) -> bool:
        """Whether this process keeps an instance."""
        return "instance" in vars(self)

    def fresh(
        self, render_mode: Literal["rgb_array"] | None = None, spec: EnvSpec | None = None
    ) -> contextlib.closing[Instance]:
        """A new instance for one experiment, closed after it; exceptions of its close are ignored."""
        return contextlib.closing(self.build(render_mode, spec))


def _accepts(env: Any, name: str) -> bool:
    """Say whether reset takes an argument: a library's wrappers do, and pass it on to an environment that may not."""
    try:
        parameters = inspect.signature(env.reset).parameters.values()
    except ValueError:  # not written in Python
        return True
    accepts = any(parameter.name == name or parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    passes_on = isinstance(env, gymnasium.Wrapper) and type(env).reset.__module__.startswith(("gymnasium.", "rlctl."))
    return accepts and (not passes_on or _accepts(env.env, name))
