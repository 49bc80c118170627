"""RL0: from the name on the command line to an environment, and to the variants of a task that a recipe switches on."""

import contextlib
import dataclasses
import difflib
import inspect
import re
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rlctl import missing_packages
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import INSTANCES, PROBE, RECORDING, experiment, judges_records
from rlctl.checking.instance import (
    Context,
    EnvironmentRaised,
    Instance,
    describe,
    display_error,
    find_first_error,
    find_missing_file,
    get_causes,
    raised_by_environment,
)
from rlctl.checking.records import FIRST_SEED, Built, ChildMessage, Records, Skipped
from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding
from rlctl.checking.step_source import read_flags
from rlctl.checking.values import find_assignment, find_author, flatten, is_task
from rlctl.environments import registry
from rlctl.environments.bullet_clients import ClientCalls, find_clients
from rlctl.environments.dict_spaces import format_space
from rlctl.environments.graphics import opengl_fix
from rlctl.environments.info import describe_mujoco_model
from rlctl.environments.mujoco_version import mujoco_fix
from rlctl.environments.places import find_line, is_own_file
from rlctl.environments.registrations import describe_registrations
from rlctl.environments.spec import EnvSpec
from rlctl.errors import (
    NoDisplayError,
    NoSuchClassError,
    OldGymError,
    RecipeError,
    RlctlError,
    TaskError,
    UsageError,
    read_message,
)

WAIVERS = "rlctl_ignore"  # The class attribute that waives rules: rule id -> reason


@experiment("build", PROBE, 10, "RL001", "RL002", "RL003", "RL005", "RL006", "RL008", "RL013", "RL216", share=0.0)
def build(context: Context) -> Iterator[ChildMessage]:
    """Build the first instance, which the process keeps. Raises `UsageError` for a name that does not exist."""
    try:
        instance = context.instance
    except EnvironmentRaised as raised:
        error = raised.cause
        is_mistake = isinstance(error, UsageError) and not isinstance(error, NoSuchClassError | OldGymError)
        if is_mistake or not isinstance(error, RlctlError):
            raise error from None  # a name that does not exist, or a bug
        yield _explain(context, error)
        return
    try:
        built = _describe_built(instance)
    except Exception as error:
        if not raised_by_environment(error):
            raise
        trace = {"traceback": "".join(traceback.format_exception(error))}
        yield RuleFinding("RL002", f"reading an attribute raises {describe(error)}", trace, where=find_line(error))
        return
    yield built
    yield from _base_class(instance)
    if is_task(instance.env):
        yield from _find_misspelled(type(find_author(instance.env)))
    clients = [ClientCalls(client) for client in find_clients()]
    if any(client.getConnectionInfo()["connectionMethod"] == client.GUI for client in clients):
        evidence = {"value": "GUI", "expected": "DIRECT"}
        yield RuleFinding("RL216", "PyBullet was connected with a window (p.GUI)", evidence)


def _explain(context: Context, error: RlctlError) -> RuleFinding:
    cause = error.__cause__
    details = {"traceback": error.details} if error.details else {}
    message, to_install = missing_packages.split(str(error), cause)
    message = message.partition("\n")[0] if isinstance(error, TaskError) else message  # what to do is the fix
    if isinstance(error, NoSuchClassError):
        return RuleFinding("RL005", str(error), details)
    missing_modules = [str(e.name) for e in get_causes(cause) if isinstance(e, ModuleNotFoundError)]
    if isinstance(error, OldGymError) or any(name.partition(".")[0] == "gym" for name in missing_modules):
        return RuleFinding("RL008", message, details, fix=to_install)
    if isinstance(error, NoDisplayError):
        return RuleFinding("RL216", message)
    if (file := find_missing_file(cause)) is not None:
        return _not_found("the constructor", file, error.details)
    where = find_line(cause) if cause is not None else None
    fix = to_install or _fix_libraries(cause)
    if first := find_first_error(cause):
        message = f"{message}; the first error was {describe(first)}"
    if context.progress.read().call == "load":
        return RuleFinding("RL001", message, details, fix=fix, where=where)
    missing = _find_missing_arguments(cause)
    if missing:
        settings = " ".join(f"--set task.{name}=..." for name in missing)
        give = f"Give them ({settings}), or give them default values."
        registered = describe_registrations(context.spec.task, "check-env")
        return RuleFinding("RL006", message, details, fix=f"{give} The class is {registered}" if registered else give)
    is_without_trace = isinstance(error, TaskError) and error.details is None  # a constructor's error has one
    if is_without_trace and not registry.is_task(registry.load(context.spec.task)):
        what_to_do = str(error).partition("\n")[2]
        return RuleFinding("RL003", message, fix=f"{what_to_do[:1].upper()}{what_to_do[1:]}")
    return RuleFinding("RL002", message, details, fix=fix, where=where)


def _fix_libraries(cause: BaseException | None) -> str:
    """Return what to do about a library that an error comes from; empty where it is the environment's own."""
    if cause is None:
        return ""
    return opengl_fix(read_message(cause)) or mujoco_fix(cause)


def _find_missing_arguments(cause: BaseException | None) -> list[str]:
    """Return the arguments that the call of the constructor lacked; none if the error is of code that it runs."""
    if not isinstance(cause, TypeError) or find_line(cause) is not None:
        return []
    missing = re.search(r"missing \d+ required .*?arguments?: (.*)", read_message(cause))
    return re.findall(r"'(\w+)'", missing[1]) if missing else []


def _base_class(instance: Instance) -> Iterator[RuleFinding]:
    bases = type(getattr(instance.env, "unwrapped", instance.env)).__mro__
    if any(base.__module__.partition(".")[0] == "gym" for base in bases):
        yield RuleFinding("RL008", "the class inherits from gym.Env, not from gymnasium.Env")
    elif not isinstance(instance.env, gymnasium.Env):
        yield RuleFinding("RL003", "the class does not inherit from gymnasium.Env")
    for name, leaves in (("observation", instance.leaves), ("action", instance.action_leaves)):
        if "NoneType" in {leaf.kind for leaf in leaves}:
            yield RuleFinding("RL003", f"there is no {name}_space")


def _find_misspelled(author: type) -> Iterator[RuleFinding]:
    from rlctl.task.batch import BatchTask
    from rlctl.task.task import Task, TaskDefinition

    known = {*vars(TaskDefinition), *TaskDefinition.__annotations__, *vars(Task), *vars(BatchTask)}
    meant = {name for name in known if not name.startswith("_")}
    for cls in author.__mro__[: author.__mro__.index(TaskDefinition)]:
        try:
            words = Counter(re.findall(r"\w+", inspect.getsource(inspect.getmodule(cls) or cls)))
        except (OSError, TypeError):
            continue  # typed in somewhere: there is no file to look for uses in
        for name in vars(cls).keys() - meant:
            close = difflib.get_close_matches(name, meant - vars(cls).keys(), n=1, cutoff=0.7)
            if close and words[name] == 1:
                message = f"nothing uses {cls.__name__}.{name}. Did you mean {close[0]!r}?"
                yield RuleFinding("RL013", message, {"value": name, "expected": close[0]})


@judges_records("RL004", "build")
def _find_end_while_loading(records: Records) -> Iterator[RuleFinding]:
    if records.built is None:
        for failure in records.failures:
            if failure.process == "probe" and failure.call in ("load", "build") and not display_error(failure):
                evidence = {"last_output": failure.details} if failure.details else {}
                yield RuleFinding("RL004", failure.message, evidence)


@judges_records("RL007", "build", *RECORDING)
def _find_missing_files(records: Records) -> Iterator[RuleFinding]:
    files = set()
    for failure in records.failures if records.built is not None else ():
        if failure.file is not None and failure.file["file"] not in files:
            files.add(failure.file["file"])
            yield _not_found(failure.call, failure.file, failure.details)


def _not_found(call: str, file: Mapping[str, Any], details: str | None) -> RuleFinding:
    where = f", looked for in {' and '.join(file['searched'])}" if file["searched"] else ""
    where = f": it is in {file['found']}; call setAdditionalSearchPath first" if file["found"] else where
    evidence = {**file, "traceback": details} if details else dict(file)
    return RuleFinding("RL007", f"{call} does not find {file['file']!r}{where}", evidence)


def _describe_built(instance: Instance) -> Built:
    env = instance.env
    inner = getattr(env, "unwrapped", env)
    spec = getattr(env, "spec", None)
    author = type(find_author(env))
    file: str | None = None
    line: int | None = None
    with contextlib.suppress(OSError, TypeError):
        file, line = inspect.getsourcefile(author), inspect.getsourcelines(author)[1]
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


STEPS = 60  # Of each variant: an event at an interval of a second acts in them


@experiment("variants", INSTANCES, 90, "RL011", "RL012", share=2.0)
def play_variants(context: Context) -> Iterator[ChildMessage]:
    """Play the task with all of its events and with none, and each of its stages, and compare equal seeds."""
    task: Any = getattr(getattr(context.instance.env, "unwrapped", None), "task", None)
    if not registry.is_task(type(task)):
        raise NotApplicable("events and stages are those of a rlctl.task.Task")
    try:
        repeats = _play(context, context.spec)
    except EnvironmentRaised:
        raise NotJudged("the task raises with and without its events (RL2)") from None
    if task.events:
        yield from _play_events(context, repeats)
    else:
        yield Skipped("RL011", "the task has no events", applies=False)
    if stages := _find_stages(context.spec.task, task):
        yield from _play_stages(context, stages)
    else:
        yield Skipped("RL012", "the task has no stages", applies=False)


def _find_stages(name: str, task: Any) -> Sequence[Any]:
    file = registry.find_recipe_file(name)
    stages = task.stages
    if file is not None and "stages" in file.read_text(encoding="utf-8", errors="replace"):
        from rlctl.recipe.sources import read  # pydantic's models take a quarter of a second to load

        stages = read(file).get("stages", stages)
    return stages if isinstance(stages, list | tuple) else ()  # another type is refused with the recipe


def _play_events(context: Context, repeats: bool) -> Iterator[RuleFinding]:
    for randomize in {True, False} - {context.spec.randomize}:
        where = f"with randomize={str(randomize).lower()}"
        try:
            same = _play(context, dataclasses.replace(context.spec, randomize=randomize))
        except EnvironmentRaised as error:
            yield RuleFinding("RL011", f"{where}: {_describe_cause(error)}")
            continue
        if repeats and not same:
            yield RuleFinding("RL011", f"{where}: equal seeds and actions give unequal episodes")


def _play_stages(context: Context, stages: Sequence[Any]) -> Iterator[RuleFinding]:
    from rlctl.environments.info import describe as describe_env  # both with pydantic's models, which load slowly
    from rlctl.recipe.recipe import validate

    spec, first = context.spec, None
    settings = {"task": spec.parameters, "events": spec.events, "randomize": spec.randomize, "stages": list(stages)}
    try:
        specs = validate(settings, "stages").env_specs(spec.task)
    except RecipeError as error:
        yield RuleFinding("RL012", str(error))
        return
    for number, stage in enumerate(specs, start=1):
        try:
            with context.fresh(spec=stage) as instance:
                _record(instance)
                description = describe_env(instance.env)
        except EnvironmentRaised as error:
            yield RuleFinding("RL012", f"stage {number} of {len(specs)}: {_describe_cause(error)}")
            continue
        first = first or description
        if difference := description.find_difference(first, "stage 1's"):
            yield RuleFinding("RL012", f"stage {number} of {len(specs)}: {difference}")


def _play(context: Context, spec: EnvSpec) -> bool:
    with context.fresh(spec=spec) as instance:
        episodes = [_record(instance) for _ in range(2)]
    shortest = min(len(episode) for episode in episodes)  # where time was up
    return bool(np.array_equal(episodes[0][:shortest], episodes[1][:shortest]))


def _record(instance: Instance) -> NDArray[np.float64]:
    episode = EpisodePlayer(instance, FIRST_SEED, max_steps=STEPS)
    return np.concatenate([flatten(moment.observation) for moment in episode])


def _describe_cause(error: EnvironmentRaised) -> str:
    return str(error.cause) if isinstance(error.cause, RlctlError) else str(error)
