"""The experiment `build`: loads and builds the environment, for rules about what prevents that and what it is."""

import contextlib
import dataclasses
import inspect
import itertools
from collections.abc import Iterator
from typing import Any

from rlctl import missing_packages
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.instance import (
    Context,
    EnvironmentRaised,
    Instance,
    describe,
    find_first_error,
    raised_by_environment,
    warning_fix,
)
from rlctl.checking.records import Built, ChildMessage
from rlctl.checking.step_source import read_flags
from rlctl.checking.values import find_assignment, find_author, is_task
from rlctl.environments.bullet_clients import find_clients
from rlctl.environments.dict_spaces import format_space
from rlctl.environments.graphics import opengl_fix
from rlctl.environments.mujoco_version import mujoco_fix
from rlctl.environments.places import find_line, is_own_file
from rlctl.environments.registrations import describe_registrations
from rlctl.environments.simulations import describe_mujoco_model
from rlctl.errors import NoSuchClassError, OldGymError, RlctlError, TaskError, UsageError, read_message

WAIVERS = "rlctl_ignore"  # The class attribute that waives rules: rule id -> reason


@dataclasses.dataclass(frozen=True)
class FailedBuild:
    """Why an environment could not be built."""

    context: Context
    error: RlctlError

    @property
    def cause(self) -> BaseException | None:
        """What the environment raised, where that is known."""
        return self.error.__cause__

    @property
    def details(self) -> dict[str, str]:
        """The evidence of a finding."""
        return {"traceback": self.error.details} if self.error.details else {}

    @property
    def message(self) -> str:
        """What went wrong, without what to do about it."""
        message, _ = missing_packages.split(str(self.error), self.cause)
        return message.partition("\n")[0] if isinstance(self.error, TaskError) else message

    @property
    def message_from_first(self) -> str:
        """The same, with the error that led to it."""
        first = find_first_error(self.cause)
        return f"{self.message}; the first error was {describe(first)}" if first else self.message

    @property
    def to_install(self) -> str:
        """What to do about a package that is missing; empty where none is."""
        return missing_packages.split(str(self.error), self.cause)[1]

    @property
    def fix(self) -> str:
        """What to do about a library that the error comes from; empty where it is the environment's own."""
        if self.to_install or self.cause is None:
            return self.to_install
        return opengl_fix(read_message(self.cause)) or mujoco_fix(self.cause) or warning_fix(self.cause)

    @property
    def where(self) -> tuple[str, int] | None:
        """File and line of the environment's code that raised it."""
        return find_line(self.cause) if self.cause is not None else None


explains_failures = JudgeHook[FailedBuild]()
"""Shows why an environment could not be built. The first part, by its place, that yields a finding explains it."""
judges_unreadable = JudgeHook[Exception]()
"""Shows what reading an attribute of the built environment raised."""
judges_built = JudgeHook[Instance]()
"""Shows the instance that was built."""
_HOOKS = (explains_failures, judges_unreadable, judges_built)


@experiment("build", PROBE, 10, share=0.0, hooks=_HOOKS)
def build(context: Context) -> Iterator[ChildMessage]:
    """Build the first instance, which the process keeps. Raises `UsageError` for a name that does not exist."""
    try:
        instance = context.instance
    except EnvironmentRaised as raised:
        error = raised.cause
        is_mistake = isinstance(error, UsageError) and not isinstance(error, NoSuchClassError | OldGymError)
        if is_mistake or not isinstance(error, RlctlError):
            raise error from None  # a name that does not exist, or a bug
        yield from itertools.islice(explains_failures.judge(FailedBuild(context, error)), 1)
        return
    try:
        built = _describe_built(instance)
    except Exception as error:
        if not raised_by_environment(error):
            raise
        yield from judges_unreadable.judge(error)
        return
    yield built
    yield from judges_built.judge(instance)


def _describe_built(instance: Instance) -> Built:
    env = instance.env
    inner = getattr(env, "unwrapped", env)
    spec = getattr(env, "spec", None)
    author = type(find_author(env))
    file: str | None = None
    line: int | None = None
    with contextlib.suppress(OSError, TypeError):
        file, line = inspect.getsourcefile(author), inspect.findsource(author)[1] + 1
    return Built(
        leaves=instance.leaves,
        action_leaves=instance.action_leaves,
        observation_space=format_space(getattr(env, "observation_space", None)),
        action_space=format_space(env.action_space),
        names=dict(inner.observation_sizes) if is_task(env) else {},
        events={name: name in inner.events for name in inner.task.events} if is_task(env) else {},
        max_steps=instance.max_steps,
        nondeterministic=bool(getattr(spec, "nondeterministic", False)),
        **read_flags(inner),
        places=_find_places(env, author, file),
        accepts_seed=instance.accepts_seed,
        accepts_options=instance.accepts_options,
        model=describe_mujoco_model(env),
        uses_pybullet=bool(find_clients()),
        registered=describe_registrations(instance.context.spec.task, "check-env"),
        waivers=_waivers(author),
        file=file,
        line=line,
    )


def _waivers(author: type) -> Any:
    waivers = getattr(author, WAIVERS, {})
    if isinstance(waivers, dict):
        return {str(rule): reason if isinstance(reason, str) else "" for rule, reason in waivers.items()}
    return {repr(waivers)[:40]: ""}


def _find_places(env: Any, author: type, file: str | None) -> dict[str, tuple[str, int]]:
    places = {name: find_assignment(env, f"self.{name}") for name in ("observation_space", "action_space")}
    for name in ("__init__", "reset", "step"):
        code = getattr(inspect.unwrap(getattr(author, name, None) or author), "__code__", None)
        places[name] = (code.co_filename, code.co_firstlineno) if code is not None else None
    found = {name: place for name, place in places.items() if place is not None}
    return {name: place for name, place in found.items() if place[0] == file or is_own_file(place[0])}
