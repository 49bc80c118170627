"""Reads an environment's own attributes: what reset draws, what it keeps, and which random generators there are."""

import collections
import contextlib
import copy
import dataclasses
import inspect
import random
import re
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.bullet_calls import LIBRARIES, is_library
from rlctl.checking.leaves import NUMBERS

MOST_NUMBERS = 64  # larger arrays are buffers, images or tables, no single quantity
MOST_ATTRIBUTES = 500
DEEPEST = 2  # Attributes of attributes are read, but no deeper
Generator = np.random.Generator | np.random.RandomState | random.Random
NO_GENERATORS = {id(np.random.mtrand._rand), id(random._inst)}  # of the whole process: RL309 watches them


def find_author(env: Any) -> Any:
    """Return the object whose class the environment's author wrote: not rlctl's environment of a task, but the task."""
    inner = getattr(env, "unwrapped", env)
    return inner.task if is_task(env) else inner


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

    @property
    def numbers(self) -> NDArray[np.float64]:
        """The numbers, flat; empty for a generator."""
        return np.zeros(0) if isinstance(self.value, Generator) else np.ravel(np.asarray(self.value, np.float64))

    def assign(self, value: Any) -> None:
        """Replace the value in the environment."""
        if isinstance(self.owner, dict):
            self.owner[self.key] = copy.deepcopy(value)
        else:
            setattr(self.owner, self.key, copy.deepcopy(value))


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
                value = value if isinstance(value, Generator) else copy.deepcopy(value)
                attributes[path] = Attribute(path, owner, key, value)
            elif depth < DEEPEST and id(value) not in seen and _is_own(value):
                visit(value, path, depth + 1)

    visit(find_author(env), "self", 0)
    return attributes


def _is_quantity(value: Any) -> bool:
    if isinstance(value, NUMBERS):
        return True
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf" and 0 < value.size <= MOST_NUMBERS
    if not isinstance(value, list | tuple | collections.deque) or not 0 < len(value) <= MOST_NUMBERS:
        return False
    sizes = [np.size(item) for item in value if isinstance(item, (*NUMBERS, np.ndarray))]
    return len(sizes) == len(value) and len(set(sizes)) == 1 and sum(sizes) <= MOST_NUMBERS


def _is_own(value: Any) -> bool:
    if isinstance(value, dict):
        return True
    is_object = hasattr(value, "__dict__") and not inspect.isroutine(value) and not inspect.isclass(value)
    return is_object and not inspect.ismodule(value) and type(value).__module__.partition(".")[0] not in LIBRARIES


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


class GeneratorWatch:
    """Watches the random generators of the instance that a process keeps."""

    def __init__(self) -> None:
        self.calls: set[tuple[str, int]] = set()  # file and line of default_rng() without a seed in reset or step
        self.before: dict[str, str] | None = None  # generator states after the first watched reset

    @contextlib.contextmanager
    def watch(self) -> Iterator[None]:
        """Note calls of `default_rng()` inside the `with` block, but those of libraries."""
        original = np.random.default_rng

        def default_rng(seed: Any = None) -> np.random.Generator:
            frame = sys._getframe(1)
            if seed is None and not is_library(frame):
                self.calls.add((frame.f_code.co_filename, frame.f_lineno))
            return original(seed)

        np.random.default_rng = default_rng
        try:
            yield
        finally:
            np.random.default_rng = original
