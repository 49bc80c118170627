"""Values taken apart: actions and observations into numbers, and the attributes that an environment holds."""

import ast
import collections
import contextlib
import copy
import dataclasses
import inspect
import math
import random
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.bullet_calls import LIBRARIES, is_library
from rlctl.environments.leaves import Leaf, pick

NUMBERS = (bool, int, float, np.bool_, np.integer, np.floating)
ArrayNames = Sequence[tuple[str, int]]
"""The name and the size of each array of a flat observation."""


def flatten_action(leaves: list[Leaf], action: Any) -> NDArray[np.float64]:
    """Return an action's numbers in the order of the action space's leaves; those of unknown kinds are left out."""
    parts = [np.ravel(pick(action, leaf.path)).astype(np.float64) for leaf in leaves if leaf.supported]
    return np.concatenate(parts) if parts else np.zeros(0)


def flatten(observation: Any) -> NDArray[Any]:
    """Return a copy of all numbers of an observation; those that are in no array of numbers are left out."""
    if isinstance(observation, dict):
        observation = tuple(observation.values())
    if isinstance(observation, (tuple, list)) and any(isinstance(part, (np.ndarray, dict)) for part in observation):
        return np.concatenate([flatten(value) for value in observation])
    try:
        array = np.array(observation)
    except Exception:  # a ragged list, or an object of its own kind
        array = np.zeros(0)
    return array.ravel() if array.dtype.kind in "biuf" else np.zeros(0)


def list_parts(observation: Any, name: str = "observation") -> Iterator[tuple[str, int]]:
    """Yield the name and the size of each array of an observation, in the order of `flatten`."""
    if isinstance(observation, dict):
        for key, value in observation.items():
            yield from list_parts(value, f"{name}[{key!r}]")
    elif isinstance(observation, (tuple, list)) and any(isinstance(part, (np.ndarray, dict)) for part in observation):
        for number, value in enumerate(observation):
            yield from list_parts(value, f"{name}[{number}]")
    else:
        yield name, flatten(observation).size


def name_numbers(parts: ArrayNames, first: int, count: int = 1) -> str:
    """Return how to write numbers of a flat observation that follow each other: `observation[3]`, or
    `observation['velocity'][0:3]`."""
    names = []
    for name, size in parts:
        begin, end = max(first, 0), min(first + count, size)
        if begin < end:
            names.append(f"{name}[{begin}]" if end == begin + 1 else f"{name}[{begin}:{end}]")
        first -= size
    return " and ".join(names)


def find_numbers(info: dict[Any, Any]) -> Iterator[tuple[str, float]]:
    """Yield the numbers of an info by name; those in a dictionary of it as `reward_terms/distance`."""
    for key, value in info.items():
        for name, number in value.items() if isinstance(value, dict) else [("", value)]:
            # Some libraries make an array without axes of a comparison.
            is_scalar = isinstance(number, np.ndarray) and number.shape == () and number.dtype.kind in "biuf"
            if isinstance(number, NUMBERS) or is_scalar:
                with contextlib.suppress(OverflowError):  # a whole number of hundreds of digits
                    yield f"{key}/{name}" if isinstance(value, dict) else str(key), float(number)


def name_type(value: Any) -> str:
    """Return a type as a user would write it: `numpy.bool`, `list`."""
    kind = type(value)
    return kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"


def read_flag(flag: Any) -> bool:
    """Return what a flag means, whatever its type; False for what has no truth, and any of a flag per agent."""
    if isinstance(flag, bool):  # nearly always; asking numpy takes a tenth of a robot's step
        return flag
    try:
        return bool(np.any(list(flag.values()) if isinstance(flag, dict) else flag))
    except Exception:  # its type is noted, and is a finding
        return False


MOST_NUMBERS = 64  # larger arrays are buffers, images or tables, no single quantity
MOST_ATTRIBUTES, DEEPEST = 500, 2  # Attributes of attributes are read, but no deeper
MOST_ITEMS = 16  # of a list or a tuple of unlike things, such as a state
Generator = np.random.Generator | np.random.RandomState | random.Random
NO_GENERATORS = {id(np.random.mtrand._rand), id(random._inst)}  # of the whole process: RL309 watches them


def find_author(env: Any) -> Any:
    """Return the object whose class the environment's author wrote: not rlctl's environment of a task, but the task."""
    if not is_task(env):
        return getattr(env, "unwrapped", env)
    return env.unwrapped.task


def list_own_classes(author: Any) -> list[type]:
    """Return the classes of an object that no library has."""
    known = (*LIBRARIES, "typing", "abc")
    return [cls for cls in type(author).__mro__ if cls.__module__.partition(".")[0] not in known]


def parse_sources(env: Any) -> dict[str, ast.Module]:
    """Return the source of the classes of an environment's author, by file; one that cannot be read is left out."""
    files: set[str] = set()
    for cls in list_own_classes(find_author(env)):
        with contextlib.suppress(TypeError):  # of a class in C, or of a module that is not a file
            files.add(str(inspect.getsourcefile(cls)))
    parsed: dict[str, ast.Module] = {}
    for file in sorted(files):
        with contextlib.suppress(OSError, SyntaxError, ValueError), open(file, encoding="utf-8") as source:
            parsed[file] = ast.parse(source.read())
    return parsed


def find_batch(env: Any) -> Any:
    """Return the `BatchTask` of an environment; None for any other."""
    batches = sys.modules.get("rlctl.task.batch")
    task = env.unwrapped.task if is_task(env) else None
    return task if batches is not None and isinstance(task, batches.BatchTask) else None


def is_task(env: Any) -> bool:
    """Say whether it is an environment of a task of rlctl."""
    task_env = sys.modules.get("rlctl.task.env")
    return task_env is not None and isinstance(getattr(env, "unwrapped", env), task_env.TaskEnv)


@dataclasses.dataclass(frozen=True)
class Attribute:
    """A number, an array of numbers, or a random generator that an object of the environment holds."""

    name: str  # `self.goal`
    owner: Any  # The object, or the dictionary, that holds it
    key: str
    value: Any  # A copy; of a generator the generator itself
    item: int | None = None  # Its place where the attribute is a list or a tuple of unlike things

    @property
    def numbers(self) -> NDArray[np.float64]:
        """The numbers, flat; empty for a generator."""
        return np.zeros(0) if isinstance(self.value, Generator) else np.ravel(np.asarray(self.value, np.float64))

    def assign(self, value: Any) -> None:
        """Replace the value in the environment."""
        value = _copy(value)
        if self.item is not None:
            whole = self._read_whole()
            items = [*whole[: self.item], value, *whole[self.item + 1 :]]
            value = _join_items(whole, items)
        self._holder[self.key] = value

    def read(self) -> Any:
        """Return the present value in the environment; raises `LookupError` where it is gone."""
        whole = self._read_whole()
        return whole if self.item is None else whole[self.item]

    def _read_whole(self) -> Any:
        return self._holder[self.key]

    @property
    def _holder(self) -> dict[str, Any]:
        """Where the owner holds it: an object that may be frozen refuses to be assigned to."""
        return self.owner if isinstance(self.owner, dict) else vars(self.owner)


def read_attributes(env: Any) -> dict[str, Attribute]:
    """Return the attributes of the object that the environment's author wrote, by name; runs none of its code."""
    attributes: dict[str, Attribute] = {}
    seen: set[int] = set()

    def visit(owner: Any, name: str, depth: int) -> None:
        seen.add(id(owner))
        items = owner if isinstance(owner, dict) else getattr(owner, "__dict__", {})
        for key, value in list(items.items()):
            if len(attributes) >= MOST_ATTRIBUTES or not isinstance(key, str):
                continue
            path = f"{name}[{key!r}]" if isinstance(owner, dict) else f"{name}.{key}"
            if _is_quantity(value) or (isinstance(value, Generator) and id(value) not in NO_GENERATORS):
                value = value if isinstance(value, Generator) else _copy(value)
                attributes[path] = Attribute(path, owner, key, value)
            elif isinstance(value, list | tuple) and 0 < len(value) <= MOST_ITEMS:
                items_of_value = [(i, item) for i, item in enumerate(value) if _is_quantity(item)]
                for i, item in items_of_value if len(items_of_value) == len(value) else ():
                    attributes[f"{path}[{i}]"] = Attribute(f"{path}[{i}]", owner, key, _copy(item), i)
            elif depth < DEEPEST and id(value) not in seen and (isinstance(value, dict) or is_own_object(value)):
                visit(value, path, depth + 1)

    visit(find_author(env), "self", 0)
    return attributes


def _is_quantity(value: Any) -> bool:
    if isinstance(value, NUMBERS):
        return fits_float(value)
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf" and 0 < value.size <= MOST_NUMBERS
    if not isinstance(value, list | tuple | collections.deque) or not 0 < len(value) <= MOST_NUMBERS:
        return False
    shapes = [np.shape(item) for item in value if isinstance(item, (*NUMBERS, np.ndarray)) and fits_float(item)]
    return len(shapes) == len(value) and len(set(shapes)) == 1 and len(shapes) * math.prod(shapes[0]) <= MOST_NUMBERS


def fits_float(value: Any) -> bool:
    """Say whether a value is no whole number of hundreds of digits."""
    return not isinstance(value, int) or abs(value) <= sys.float_info.max


def is_own_object(value: Any) -> bool:
    """Say whether a value is an object of a class of the environment's author."""
    is_object = hasattr(value, "__dict__") and not inspect.isroutine(value) and not inspect.isclass(value)
    return is_object and not inspect.ismodule(value) and type(value).__module__.partition(".")[0] not in LIBRARIES


def shape_like(value: Any, numbers: NDArray[np.float64]) -> Any:
    """Return numbers in the form of a value: an array, a number, or a list or a tuple of such; of its precision, since
    a space of float32 does not contain an array of float64."""
    if isinstance(value, np.ndarray):
        dtype = value.dtype if value.dtype.kind == "f" else numbers.dtype
        return numbers.reshape(value.shape).astype(dtype)
    if isinstance(value, np.floating):
        return value.dtype.type(numbers[0])
    if not isinstance(value, list | tuple | collections.deque):
        return float(numbers[0])
    parts = np.split(numbers, np.cumsum([np.size(item) for item in value])[:-1])
    items = [shape_like(item, part) for item, part in zip(value, parts, strict=True)]
    return _join_items(value, items)


def _join_items(like: Any, items: Sequence[Any]) -> Any:
    """Return items in a list, a tuple or a queue of the type of another one, whatever its own constructor takes."""
    if isinstance(like, tuple):
        return tuple.__new__(type(like), items)
    joined = copy.copy(like)  # a queue keeps its length
    joined.clear()
    joined.extend(items)
    return joined


def _copy(value: Any) -> Any:
    if isinstance(value, list | tuple | collections.deque):
        return _join_items(value, [copy.deepcopy(item) for item in value])
    return copy.deepcopy(value)


def find_unequal(one: Mapping[str, Attribute], two: Mapping[str, Attribute]) -> list[str]:
    """Return the names whose numbers differ, of those that both have with the same shape."""
    shared = [name for name in one.keys() & two.keys() if one[name].numbers.shape == two[name].numbers.shape]
    return sorted(n for n in shared if not np.array_equal(one[n].numbers, two[n].numbers, equal_nan=True))


def read_generators(env: Any) -> dict[str, str]:
    """Return the state of each random generator, as text, by name."""
    values = {name: attribute.value for name, attribute in read_attributes(env).items()}
    return {name: _state(value) for name, value in values.items() if isinstance(value, Generator)}


def _state(generator: Any) -> str:
    if isinstance(generator, np.random.Generator):
        return str(generator.bit_generator.state)
    if isinstance(generator, np.random.RandomState):
        kind, keys, *rest = generator.get_state()
        return str((kind, np.asarray(keys).tobytes(), rest))
    return str(generator.getstate())


def find_assignment(env: Any, name: str) -> tuple[str, int] | None:
    """Return file and line of the first assignment to an attribute, given as `self.rng`; None if there is none."""
    with contextlib.suppress(OSError, TypeError):
        author = type(find_author(env))
        for cls in author.__mro__:
            if cls is not author and cls.__module__.partition(".")[0] in LIBRARIES:
                continue
            lines, first = inspect.getsourcelines(cls)
            for number, line in enumerate(lines):
                if re.match(rf"\s*{re.escape(name)}\s*(:[^=]+)?=[^=]", line):
                    return str(inspect.getsourcefile(cls)), first + number
    return None


@contextlib.contextmanager
def watch_unseeded(calls: set[tuple[str, int]]) -> Iterator[None]:
    """Add file and line of each call of `default_rng()` without a seed inside the `with` block, except in libraries."""
    original = np.random.default_rng

    def default_rng(seed: Any = None) -> np.random.Generator:
        frame = sys._getframe(1)
        if seed is None and not is_library(frame):
            calls.add((frame.f_code.co_filename, frame.f_lineno))
        return original(seed)

    np.random.default_rng = default_rng
    try:
        yield
    finally:
        np.random.default_rng = original
