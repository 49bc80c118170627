"""Resolve a task's name to its environment's constructor, its files and its version; import and call its code.

A task is written as an installed name (`reach`), `package.module:Class`, `path/to/file.py:Class`, or a Gymnasium id
(`Pendulum-v1`, `package:Env-v0`).
"""

import contextlib
import importlib
import importlib.util
import inspect
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rlctl import errors, missing_packages
from rlctl.entry_points import OURS, find_module_file
from rlctl.environments import installed, own_files, own_ids, suggestions
from rlctl.environments.graphics import opengl_fix
from rlctl.environments.mujoco_version import mujoco_fix
from rlctl.environments.places import describe_exception_place
from rlctl.errors import NoSuchClassError, OldGymError, RlctlError, TaskError, UsageError, did_you_mean
from rlctl.storage import files

PRESETS = Path(__file__).parents[1] / "recipe" / "presets"
"""Preset recipes: `--config presets/NAME`."""
_MOST_NAMED = 4  # classes of a file, or files of a task
_GYMNASIUM_ID = re.compile(r"^(?!.*\.py:)(?:(?:[\w.]+:)?(?:[\w.-]+/)?[\w.-]+-v\d+|[\w.]+:[\w.-]+/[\w.-]+)$")
"""An id with a version, or one of a module with a namespace, as `metaworld:Meta-World/MT1`: no class has that form."""


def load(task: str) -> Callable[..., Any]:
    """Import what `task` names: a `Task` class, or anything that returns a Gymnasium environment when called.

    For a task named by path, or by a module that is not installed, the current folder becomes the last entry of
    `sys.path`.
    """
    if entry := installed.find(task):
        if entry.problem:
            raise TaskError(f"task {task!r} of {entry.distribution} {entry.version}: {entry.problem}")
        return _load_target(task, entry.target)
    if _GYMNASIUM_ID.match(task):
        package = task.rpartition(":")[0]
        if package and find_module_file(package, in_current_folder=True) is not None:
            _append_current_folder(package)
            import_module(task, package)  # separately, so that an exception is reported as one of the import
        return _load_gymnasium(task)
    if ":" in task.rstrip(":"):
        _append_current_folder(task.rpartition(":")[0])
        return _load_target(task, task)
    if _is_registered(task):
        return _load_gymnasium(task)  # an id without a version, of a plugin that Gymnasium has loaded
    for file in (Path(os.path.expanduser(task.rstrip(":"))), Path(f"{task}.py"), Path(f"{task.lower()}.py")):
        if file.suffix == ".py" and file.is_file():
            classes = suggestions.list_classes(file)
            forms = " or ".join(f"{file}:{name}" for name in classes[:_MOST_NAMED]) or f"{file}:CLASS"
            raise UsageError(f"no task {task!r} is installed; to name a class in {file}: {forms}")
    if task and Path(task).is_dir():
        forms = f"pip install -e {task} installs a plugin; or name a class: {task}/FILE.py:CLASS"
        raise UsageError(f"{task} is a folder, not a task: {forms}")
    if model := suggestions.explain_model_file(task):
        raise UsageError(model)
    if "/" in task and (module := own_ids.find_registering_module(task)):
        raise _name_module(task, module)
    names = [entry.name for entry in installed.list_installed()]
    listed, close = ", ".join(dict.fromkeys(names)) or "none", suggestions.suggest(task)
    close, forms = (
        close or suggestions.suggest_name(task, names) or ".",
        "package.module:Class, path/to/file.py:Class, Pendulum-v1.",
    )
    raise UsageError(f"no task {task!r}{close} Installed: {listed}. Other forms: {forms}")


def _is_registered(task: str) -> bool:
    import gymnasium

    return task in gymnasium.registry


def is_task(constructor: Any) -> bool:
    """Return whether a constructor is a `Task` or a `BatchTask` of `rlctl.task`."""
    module = sys.modules.get("rlctl.task.task")
    return module is not None and inspect.isclass(constructor) and issubclass(constructor, module.TaskDefinition)


def is_gymnasium_id(task: str) -> bool:
    """Return whether a task is named by a Gymnasium id: `Env-v0`, `package:Env-v0` or `package:Namespace/Env`."""
    return installed.find(task) is None and _GYMNASIUM_ID.match(task) is not None


def is_missing(task: str) -> bool:
    """Return whether a name has the form of an installed task and none is installed with it."""
    return ":" not in task and not (installed.find(task) or is_gymnasium_id(task) or _is_registered(task))


def find_recipe_file(task: str) -> Path | None:
    """Return the recipe that comes with a task: `<name>.yaml` next to its module, or `<file>.yaml` next to its file.

    That of a Gymnasium id is the preset of its name, such as `presets/ant-v5`, or of another version of that name.
    """
    if entry := installed.find(task):
        return entry.recipe_file
    if _GYMNASIUM_ID.match(task):
        return _find_preset(task.lower())
    file = find_source_file(task)
    recipe = file.with_suffix(".yaml") if file else None
    return recipe if recipe and recipe.is_file() else None


def _find_preset(task: str) -> Path | None:
    preset = PRESETS / f"{task}.yaml"
    if preset.is_file():
        return preset
    name, dash, _ = task.rpartition("-v")
    return max(PRESETS.glob(f"{name}-v*.yaml"), default=None) if dash else None


def find_source_file(task: str) -> Path | None:
    """Return the file that a task is written in, found without importing it; None for a Gymnasium id."""
    if entry := installed.find(task):
        return entry.module_file
    if _GYMNASIUM_ID.match(task) or ":" not in task:
        return None
    place = task.rpartition(":")[0]
    return Path(place) if place.endswith(".py") else find_module_file(place, in_current_folder=True)


def find_origin(task: str) -> dict[str, str]:
    """Return the `distribution` and `version` of an installed task; empty for any other."""
    entry = installed.find(task)
    return {"distribution": entry.distribution, "version": entry.version} if entry else {}


def identify_task(task: str) -> dict[str, Any]:
    """Return `origin` (distribution and version of an installed task) and `source_sha256` of the task's file.

    Of a Gymnasium id it is the file of its class; None if it cannot be found without an import.
    """
    source = _find_hashed_file(task)
    digest = files.digest(source.read_bytes()) if source is not None and source.is_file() else None
    return {"origin": find_origin(task), "source_sha256": digest}


def identify_files(task: str) -> dict[str, str]:
    """Return the SHA-256 of what a task's file needs besides itself: modules and model files of its package or folder.

    Of rlctl's own tasks nothing: their distribution's version says it.
    """
    if find_origin(task).get("distribution") in OURS:
        return {}
    return own_files.digest_own_files(_find_hashed_file(task))


def describe_task_changes(before: Mapping[str, Any], task: str, since: str = "the run began") -> list[str]:
    """Describe how a task differs from an earlier result of `identify_task`, and of `identify_files` as `files_sha256`
    where it is known; empty if it does not."""
    now = identify_task(task)
    earlier, later = (origin if isinstance(origin, dict) else {} for origin in (before.get("origin"), now["origin"]))
    if earlier != later:
        names = (" ".join(map(str, origin.values())) or "no installed package" for origin in (earlier, later))
        return ["task {} came from {} when {since}, and comes from {} now".format(task, *names, since=since)]
    if before.get("source_sha256") != now["source_sha256"]:
        file = _find_hashed_file(task)
        if file is None:
            return []  # it is not found from here
        return [f"{file} {f'has changed since {since}' if file.is_file() else 'no longer exists'}"]
    if isinstance(needed := before.get("files_sha256"), dict) and needed != (files_now := identify_files(task)):
        changed = [name for name in sorted({*needed, *files_now}) if needed.get(name) != files_now.get(name)]
        named = ", ".join(changed[:_MOST_NAMED]) + (" and others" if len(changed) > _MOST_NAMED else "")
        return [f"{named} of {task} {'has' if len(changed) == 1 else 'have'} changed since {since}"]
    return []


def _find_hashed_file(task: str) -> Path | None:
    return own_ids.find_class_file(task) if is_gymnasium_id(task) else find_source_file(task)


def find_git_commit() -> str | None:
    """Return the commit of the current folder's repository; None outside of one."""
    try:
        result = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5.0, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() or None


def make_slug(task: str) -> str:
    """Return a folder name for a task: `reach`, `MyEnv`, `Pendulum-v1`."""
    return re.sub(r"[^\w.-]+", "-", task.rpartition(":")[2]).strip("-.") or "task"


def _load_target(task: str, target: str) -> Callable[..., Any]:
    place, _, attribute = target.rpartition(":")
    module = import_file(task, Path(place)) if place.endswith(".py") else import_module(task, place)
    registered = attribute in getattr(sys.modules.get("gymnasium"), "registry", ())
    if registered and not callable(getattr(module, attribute, None)):
        return _load_gymnasium(attribute)  # an id without a version; a submodule may have its name
    constructor = module
    for part in attribute.split("."):
        if not hasattr(constructor, part):
            classes = [name for name, value in vars(module).items() if inspect.isclass(value)]
            own = [name for name in classes if getattr(module, name).__module__ == module.__name__]
            close, defined = did_you_mean(attribute, classes), ", ".join(own) or "no class"
            raise NoSuchClassError(f"{place} has no {attribute!r}.{close} It defines: {defined}.")
        constructor = getattr(constructor, part)
    if not callable(constructor):
        kind = type(constructor).__name__
        raise NoSuchClassError(f"{target}: {attribute} is of type {kind}, not a class or a function")
    return constructor


def may_make_environments(constructor: Any) -> bool:
    """Return whether to call it: a class with reset and step, or a function whose file mentions Gymnasium or rlctl."""
    if inspect.isclass(constructor):
        return hasattr(constructor, "reset") and hasattr(constructor, "step")
    function = inspect.unwrap(getattr(constructor, "func", constructor))  # of a partial
    try:
        source = Path(inspect.getfile(function if inspect.isfunction(function) else type(function))).read_bytes()
    except (TypeError, OSError):  # not written in Python
        return False
    return re.search(rb"gym|rlctl", source) is not None


def _load_gymnasium(task: str) -> Callable[..., Any]:
    import gymnasium

    spec = gymnasium.registry.get(task.rpartition(":")[2])
    if spec is not None and isinstance(spec.entry_point, str):
        module = spec.entry_point.partition(":")[0]
        if find_module_file(module) is not None:
            import_module(task, module)  # as in `load`: report exceptions of the import separately

    def constructor(**parameters: Any) -> Any:
        with _explain_unregistered(task):
            return gymnasium.make(task, disable_env_checker=True, **parameters)

    constructor.gymnasium_id = task  # type: ignore[attr-defined]
    return constructor


def check_registered(constructor: Callable[..., Any]) -> None:
    """Raise `UsageError` if this is the constructor of an id that Gymnasium does not know; nothing is built."""
    import gymnasium

    if (task := getattr(constructor, "gymnasium_id", None)) is not None:
        module, _, name = task.rpartition(":")
        with _explain_unregistered(task):
            if module:
                importlib.import_module(module)  # where `load` did not find it
            gymnasium.spec(name)  # which knows no module, unlike `gymnasium.make`


@contextlib.contextmanager
def _explain_unregistered(task: str) -> Iterator[None]:
    import gymnasium

    try:
        yield
    except gymnasium.error.UnregisteredEnv:
        package, colon, name = task.rpartition(":")
        old = getattr(sys.modules.get("gym"), "envs", None)  # imported, so an id may be registered there
        registry = getattr(old, "registry", {})
        if name in getattr(registry, "env_specs", registry):
            known = f"{name} is registered with the old gym package"
            raise OldGymError(f"{known}; Gymnasium cannot find it there") from None
        if module := own_ids.find_registering_module(task):
            raise _name_module(task, module) from None
        forms = "" if ":" in task else f" If a package registers it, write PACKAGE:{task}."
        close = did_you_mean(task, [f"{package}{colon}{known}" for known in gymnasium.registry])
        raise UsageError(f"Gymnasium has no environment {task!r}.{close}{forms}") from None
    except (gymnasium.error.DeprecatedEnv, ModuleNotFoundError) as error:
        missing = getattr(error.__cause__, "name", None) or getattr(error, "name", None)
        if missing and missing != task.partition(":")[0]:
            raise  # the module exists, but one of its own imports does not
        advice = missing_packages.advise_on(missing or "")
        raise UsageError(f"Gymnasium: {task}: {str(error).rstrip('.')}{advice}") from None


def _name_module(task: str, module: str) -> UsageError:
    return UsageError(f"{module} registers {task}, which Gymnasium cannot know: write {module}:{task}")


def call_plugin(task: str, call: Callable[[], Any], doing: str = "") -> Any:
    """Call a plugin's code; any exception from it, `SystemExit` included, becomes a `TaskError`."""
    try:
        return call()
    except (RlctlError, KeyboardInterrupt):
        raise
    except BaseException as error:
        where = describe_exception_place(error)
        reason, details = errors.describe_exception(error, where), errors.format_plugin_traceback(error) or None
        hint = opengl_fix(reason) or mujoco_fix(error)
        message = f"task {task!r}: {doing}{reason}" + (f"\n{hint}" if hint else "")
        raise TaskError(message, details=details) from error


def import_module(task: str, name: str) -> Any:
    """Import a module that is installed or in the current folder; raises `TaskError` for any exception in it."""
    is_installed = name in sys.modules or find_module_file(name) is not None
    if not is_installed and find_module_file(name, in_current_folder=True) is None:
        hint = missing_packages.advise_on(name) or suggestions.suggest(task) or installed.explain_hidden_package(name)
        raise UsageError(f"task {task!r}: no module {name!r} is installed or under {os.getcwd()}{hint}")
    return call_plugin(task, lambda: importlib.import_module(name), doing="import failed: ")


def _append_current_folder(module: str) -> None:
    """Append the current folder to `sys.path`, unless an installed module is meant: there the folder of its project,
    which may have the same name, would be taken for a namespace package."""
    if module.endswith(".py") or find_module_file(module) is None:
        append_to_path(os.getcwd())


def import_file(task: str, file: Path) -> Any:
    """Import a file as a module, once; a file of a package (`__init__.py` next to it) as the package's module.

    The folder above the package and the file's own folder become the last entries of `sys.path`.
    """
    file = _find_loaded(file.expanduser())
    if not file.is_file():
        raise UsageError(f"task {task!r}: no file {file}{suggestions.suggest(task)}")
    path = str(file)
    for loaded, known in list(sys.modules.items()):
        if getattr(known, "__file__", None) == path and loaded != "__main__":
            return known
    if in_package := _import_from_package(task, file):
        return in_package
    append_to_path(str(file.parent))
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
        call_plugin(task, lambda: loader.exec_module(module), doing="import failed: ")
    except BaseException:
        sys.modules.pop(name, None)
        raise
    return module


def _import_from_package(task: str, file: Path) -> Any:
    """Import a file as a module of its package; None if it is in none. Raises `UsageError` if the name is taken."""
    root, names = file.parent, [] if file.name == "__init__.py" else [file.stem]
    while (root / "__init__.py").is_file() and root.name.isidentifier():
        root, names = root.parent, [root.name, *names]
    if root == file.parent or "." in file.stem:
        return None
    for folder in (root, file.parent):
        append_to_path(str(folder))
    package, name = names[0], ".".join(names)
    own, found = root / package / "__init__.py", find_module_file(package)
    if found is None or found.resolve() != own:
        fix = f"rename the folder {package!r}, or delete its __init__.py"
        if found is not None and find_module_file(name) is not None:  # a copy of the package, probably
            fix = f"name the installed module, {name}:{task.rpartition(':')[2]}; or {fix}"
        elsewhere = found or "its own modules"
        problem = f"{file.name} belongs to the package {own.parent}, but Python imports {package!r} from {elsewhere}"
        raise UsageError(f"task {task!r}: {problem}\n{fix}")
    return call_plugin(task, lambda: importlib.import_module(name), doing="import failed: ")


def append_to_path(folder: str) -> None:
    """Append a folder to `sys.path`; it comes last so that a `torch.py` in it does not hide torch."""
    if folder not in sys.path:
        sys.path.append(folder)


def _find_loaded(file: Path) -> Path:
    """Return a file's absolute path, also if the working directory has changed since the file was loaded."""
    loaded = (getattr(module, "__file__", None) or "" for module in list(sys.modules.values()))
    before = None if file.exists() else next((path for path in loaded if Path(path).match(str(file))), None)
    return Path(before or file).resolve()
