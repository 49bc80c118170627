"""A policy as C99: a header and a source file without dependencies."""

import dataclasses
import math
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import split_space
from rlctl.errors import AnswerIsNo, UsageError, short_repr
from rlctl.exporting.c_network import list_functions, write_action, write_network
from rlctl.policy import own_modules
from rlctl.policy.c_policy import action_type, observation_type
from rlctl.policy.c_writer import CWriter, write_array, write_number
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.layers import ScaleImage
from rlctl.policy.load import LIBRARY_SUFFIX
from rlctl.policy.network import Network
from rlctl.version import __version__

LARGEST = 3_000_000  # most weights in a C file: about 40 MB of text, for which a compiler needs a minute
FLAGS = ("-std=c99", "-O3", "-Wall", "-Wextra", "-pedantic")
_NUMBERS = {"float32": "float", "float64": "double"}


@dataclasses.dataclass(frozen=True)
class CSource:
    """The content of a C header and its source file."""

    name: str  # prefix of all names in the header
    header: str
    source: str
    prototype: str  # declaration of the function that acts
    harness: str  # C functions with the same names for every policy, for calls through ctypes


@dataclasses.dataclass(frozen=True)
class Element:
    """A named part of the observation, or an element of the action."""

    name: str
    size: int
    unit: str = ""  # empty if unknown


class CFunction:
    """The elements of the C function's observation and action; `name` is the prefix of all names in the header."""

    def __init__(self, name: str, info: PolicyInfo) -> None:
        self.name = name
        self.info = info
        space, self.action_space = info.env.spaces()
        self.frames = info.spec.frame_stack
        self.parts = split_space(space)
        self.sizes = {key: math.prod(part.shape or ()) for key, part in self.parts.items()}
        self.size = sum(self.sizes.values()) // self.frames
        self.type = _NUMBERS[observation_type(info.env).name]
        self.action_type = _NUMBERS.get(action_type(info.env).name, "int")
        self.action_size = math.prod(self.action_space.shape or ())
        units = info.env.observation_units
        self.observed = [
            Element(name, size, units.get(name, "")) for name, size in info.env.find_sizes(self.frames).items()
        ]
        self.actions = self._list_actions()

    def _list_actions(self) -> list[Element]:
        joints = self.info.env.joints
        if joints and len(joints.names) == self.action_size:
            return [Element(name, 1) for name in joints.names]
        return [Element(f"action[{index}]", 1) for index in range(self.action_size)]

    def describe_observation(self) -> list[str]:
        """Return a line per named part of the observation: its indices, name and unit."""
        lines, first = [], 0
        for part in self.observed:
            unit = f" [{part.unit}]" if part.unit else ""
            if (count := self.info.env.observation_history.get(part.name, 1)) > 1:
                unit += f", the last {count}, oldest first"
            index = f"[{first}]" if part.size == 1 else f"[{first}..{first + part.size - 1}]"
            lines.append(f"  {index:<10} {part.name}{unit}")
            first += part.size
        return lines

    def describe_action(self) -> list[str]:
        """Return lines on the meaning of the action and its bounds."""
        meaning = self.info.env.action_meaning or "action of the environment"
        space, actions = self.action_space, self.actions
        if not isinstance(space, spaces.Box):
            return [f"  {meaning}: {' '.join(str(space).split())}, counted from 0"]
        bounds = zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)
        ranges = [f"from {low:.6g} to {high:.6g}" for low, high in bounds]
        if actions[0].name != "action[0]":
            ranges = [f"{joint.name}, {limits}" for joint, limits in zip(actions, ranges, strict=True)]
        elif len(set(ranges)) == 1:
            return [f"  {meaning}; every element {ranges[0]}"]
        return [f"  {meaning}", *(f"  [{index}] {limits}" for index, limits in enumerate(ranges))]

    def list_arrays(self) -> list[tuple[str, str, str, list[str]]]:
        """Return the header's constant arrays: type, name, the macro of the length, and the values as C."""
        low, high = _write_bounds(self.parts.values(), self.size, self.type)
        action_low, action_high = _write_bounds([self.action_space], self.action_size, self.action_type)
        return [
            ("char *const", "observation_names", "OBSERVATION_PARTS", [quote(part.name) for part in self.observed]),
            ("char *const", "observation_units", "OBSERVATION_PARTS", [quote(part.unit) for part in self.observed]),
            ("int", "observation_sizes", "OBSERVATION_PARTS", [str(part.size) for part in self.observed]),
            (self.type, "observation_low", "OBSERVATION_SIZE", low),
            (self.type, "observation_high", "OBSERVATION_SIZE", high),
            ("char *const", "action_names", "ACTION_SIZE", [quote(element.name) for element in self.actions]),
            (self.action_type, "action_low", "ACTION_SIZE", action_low),
            (self.action_type, "action_high", "ACTION_SIZE", action_high),
        ]


def _write_bounds(parts: Iterable[spaces.Space[Any]], size: int, kind: str) -> list[list[str]]:
    """Return the lowest and the highest values of the last `size` elements; of stacked frames these are the newest."""
    sides = zip(*(_find_part_bounds(part) for part in parts), strict=True)
    return [[write_number(value, kind) for value in np.concatenate(side, axis=None)[-size:]] for side in sides]


def _find_part_bounds(space: spaces.Space[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    if isinstance(space, spaces.Box):
        return space.low, space.high
    if isinstance(space, spaces.Discrete):
        return np.array(0), np.array(space.n - 1)
    highest = space.nvec - 1 if isinstance(space, spaces.MultiDiscrete) else np.ones(space.shape or (), int)
    return np.zeros_like(highest), highest


def quote(text: str) -> str:
    """Return a text in UTF-8 as a C string literal."""
    plain = {*range(32, 127)} - set(b'"\\?')  # two question marks start a trigraph
    return '"' + "".join(chr(byte) if byte in plain else f"\\{byte:03o}" for byte in text.encode()) + '"'


def write_c(policy: PolicyFile, file_name: str) -> CSource:
    """Write a policy as C; names of functions begin with the name of the file: `reach.c` -> `reach_act`.

    Raises `UsageError` for images, a user's own network, and networks of more than `LARGEST` weights.
    """
    check_can_be_written(policy)
    name, network = make_identifier(file_name), Network(policy)
    layout = CFunction(name, policy.info)
    has_images = any(isinstance(layer, ScaleImage) for part in network.parts.values() for layer in part)
    if has_images or (layout.frames > 1 and [len(part.shape or ()) for part in layout.parts.values()] != [1]):
        raise UsageError("export --c: networks for images cannot be written as C; use export --onnx")
    if isinstance(layout.action_space, spaces.Box) and layout.action_space.dtype.kind != "f":
        raise UsageError(f"export --c: an action of type {layout.action_space.dtype} cannot be written as C")
    writer = CWriter()
    source = "state->frames" if layout.frames > 1 else "observation"
    value = write_network(writer, network, layout.sizes, source)
    write_action(writer, network, value, layout.action_space, layout.action_type)
    state = []
    if layout.frames > 1:
        state += [f"{layout.type} frames[{layout.frames * layout.size}]; /* oldest first */", "int begun;"]
    if (lstm := network.lstm) is not None:
        state += [f"float {member}[{len(lstm.layers) * lstm.hidden_size}];" for member in ("hidden", "cell")]
    state_argument = f"{name}_state *state, " if state else ""
    values: dict[str, Any] = {
        "name": name,
        "upper": name.upper(),
        "version": __version__,
        "info": policy.info,
        "layout": layout,
        "arrays": layout.list_arrays(),
        "state": state,
        "prototype": f"void {name}_act(const {layout.type} *observation, {state_argument}{layout.action_type} *action)",
        "constants": writer.constants,
        "functions": list_functions(writer),
        "statements": writer.statements,
    }
    header, source, harness = (render(file, values) for file in ("policy.h", "policy.c", "harness.c"))
    return CSource(name, header, source, values["prototype"], harness)


def check_can_be_written(policy: PolicyFile) -> None:
    """Raise `UsageError` for a user's own network, and for one of more than `LARGEST` weights."""
    if (weights := sum(tensor.size for tensor in policy.actor_only().tensors.values())) > LARGEST:
        raise UsageError(f"export --c: {weights:,} weights are too many, the limit is {LARGEST:,}; use export --onnx")
    for key in own_modules.KEYS:
        if isinstance(own := policy.info.policy_kwargs.get(key), dict):
            raise UsageError(f"export --c: the {key} {own['class']} cannot be written as C; use export --onnx")


def render(file: str, values: dict[str, Any]) -> str:
    """Return the content of a file from its template."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates"), encoding="utf-8"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["comment"] = _write_comment
    environment.filters["one_line"] = lambda text: " ".join(_write_comment(text).split()).replace("/* *", "/*")
    environment.globals["write_array"] = write_array
    return environment.get_template(f"{file}.jinja").render(values)


def _write_comment(text: str) -> str:
    """Return a C comment; names of a task cannot end it early."""
    plain = [" ".join(line.split()) if line.lstrip() == line else line for line in text.strip().split("\n")]
    safe = [re.sub(r"[\r\v\f\0]", " ", line).replace("*/", "* /").replace("/*", "/ *").rstrip("\\") for line in plain]
    return "/* " + "\n".join(f" * {line}".rstrip() for line in safe)[3:] + "\n */"


def make_identifier(text: str) -> str:
    """Return a name in C for the name of a file."""
    plain = re.sub(r"\W", "_", text, flags=re.ASCII)
    return plain if re.match(r"[A-Za-z]", plain) else f"policy_{plain}"


def find_compiler() -> list[str] | None:
    """Return the command of the C compiler, `$CC` or `cc`; None if there is none."""
    command = shlex.split(os.environ.get("CC", "")) or ["cc"]
    return command if shutil.which(command[0]) else None


def build_library(code: CSource, info: PolicyInfo, folder: Path, compiler: list[str]) -> Path:
    """Compile a policy in `folder` and return the library; raises `AnswerIsNo` if the compiler fails."""
    library = compile_code(code, "policy", [f"{code.name}.c", "harness.c"], folder, compiler)
    library.with_suffix(".json").write_text(info.model_dump_json())
    return library


def compile_code(code: CSource, what: str, sources: Sequence[str], folder: Path, compiler: list[str]) -> Path:
    """Write code into `folder`, compile the files `sources` of it, and return the library.

    Raises `AnswerIsNo`, which names `what` it is, if the compiler fails.
    """
    for name, content in (
        (f"{code.name}.h", code.header),
        (f"{code.name}.c", code.source),
        ("harness.c", code.harness),
    ):
        (folder / name).write_text(content, encoding="utf-8")
    library = folder / f"{code.name}{LIBRARY_SUFFIX}"
    command = [*compiler, *FLAGS, "-fPIC", "-shared", "-o", str(library), *sources, "-lm"]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    except OSError as error:
        raise AnswerIsNo(f"{compiler[0]} cannot be started: {error.strerror or error}") from None
    if done.returncode != 0:
        raise AnswerIsNo(f"{compiler[0]} cannot compile the {what}: {short_repr(done.stderr, 300)}")
    return library
