"""A policy as C99: a header and a source file without dependencies."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

from gymnasium import spaces

from rlctl.environments.dict_spaces import SINGLE, split_space
from rlctl.errors import AnswerIsNo, UsageError, short_repr
from rlctl.exporting.c_layers import CWriter
from rlctl.output import format_count
from rlctl.policy.c_policy import LIBRARY_SUFFIX, action_type, observation_type
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.layers import ScaleImage
from rlctl.policy.network import Network
from rlctl.version import __version__

LARGEST = 3_000_000
"""Weights that a C file may have: some 40 MB of text, which a compiler takes a minute for."""
FLAGS = ("-std=c99", "-O3", "-Wall", "-Wextra", "-pedantic")
_TIMEOUT_S = 300.0  # of a compiler
_NUMBERS = {"float32": "float", "float64": "double"}


@dataclasses.dataclass(frozen=True)
class CSource:
    """The texts of the two files, and what they define."""

    name: str
    """Prefix of everything that the header declares."""
    header: str
    source: str
    prototype: str
    """Declaration of the function that acts."""
    has_state: bool

    @property
    def harness(self) -> str:
        """C with the same names for every policy, for a library that is called through ctypes."""
        state = f"({self.name}_state *)state, " if self.has_state else ""
        size = f"sizeof({self.name}_state)" if self.has_state else "0"
        return f"""#include <stddef.h>
#include "{self.name}.h"

size_t rlctl_state_size(void)
{{
    return {size};
}}

void rlctl_act(const void *observation, void *state, void *action)
{{
    (void)state;
    {self.name}_act(observation, {state}action);
}}

void rlctl_repeat(const void *observation, void *state, void *action, long count)
{{
    for (long i = 0; i < count; ++i) {{
        rlctl_act(observation, state, action);
    }}
}}
"""


def write_c(policy: PolicyFile, file_name: str) -> CSource:
    """Write a policy as C; functions are called after the file, `reach.c` -> `reach_act`.

    Raises `UsageError` for what has no translation: images, and networks of more than `LARGEST` weights.
    """
    info = policy.info
    if (weights := sum(tensor.size for tensor in policy.actor_only().tensors.values())) > LARGEST:
        raise UsageError(
            f"export --c: {weights:,} weights are too many for a C file (at most {LARGEST:,}); rlctl export --onnx"
        )
    name, layout, network = _make_identifier(file_name), _Layout(info), Network(policy)
    has_images = any(isinstance(layer, ScaleImage) for part in network.parts.values() for layer in part)
    if has_images or (layout.frames > 1 and [len(part.shape or ()) for part in layout.parts.values()] != [1]):
        raise UsageError("export --c: images cannot be written as C; rlctl export --onnx can")
    if isinstance(layout.action_space, spaces.Box) and layout.action_space.dtype.kind != "f":
        raise UsageError(f"export --c: an action of type {layout.action_space.dtype} cannot be written as C")
    writer = CWriter()
    writer.statements += _stack_frames(layout)
    value, size = writer.write(network, layout.sizes, "state->frames" if layout.frames > 1 else "observation")
    writer.write_action(network, value, size, layout.action_space, layout.action_type)
    members = layout.list_state() if layout.frames > 1 else []
    if network.lstm is not None:
        members += [f"float {member}[{network.lstm.state[0].size}];" for member in ("hidden", "cell")]
    state_argument = f"{name}_state *state, " if members else ""
    prototype = f"void {name}_act(const {layout.type} *observation, {state_argument}{layout.action_type} *action)"
    header = _write_header(name, info, layout, members, prototype)
    source = _write_source(name, info, writer, prototype)
    return CSource(name, header, source, prototype, bool(members))


def _make_identifier(text: str) -> str:
    plain = re.sub(r"\W", "_", text, flags=re.ASCII)
    return plain if re.match(r"[A-Za-z]", plain) else f"policy{plain if plain.startswith('_') else f'_{plain}'}"


class _Layout:
    """Which element of the C function's observation is what."""

    def __init__(self, info: PolicyInfo) -> None:
        self.info = info
        space, self.action_space = info.env.spaces()
        self.frames = info.spec.frame_stack
        self.parts = split_space(space)
        self.sizes = {key: math.prod(part.shape or ()) for key, part in self.parts.items()}
        self.size = sum(self.sizes.values()) // self.frames
        self.type = _NUMBERS[observation_type(info).name]
        self.action_type = _NUMBERS.get(action_type(info).name, "int")
        self.action_size = math.prod(self.action_space.shape or ())

    def list_state(self) -> list[str]:
        """Return the part of the state that remembers earlier observations."""
        return [f"{self.type} frames[{self.frames * self.size}]; /* oldest first */", "int begun;"]

    def list_elements(self) -> list[str]:
        """Return a line per name in an observation: its elements, size and unit."""
        env = self.info.env
        sizes = env.observation_sizes or {key or "observation": size for key, size in self.sizes.items()}
        if SINGLE not in self.parts:
            sizes = self.sizes
        lines, first = [], 0
        for name, size in sizes.items():
            unit = f" [{env.observation_units[name]}]" if env.observation_units.get(name) else ""
            place = f"[{first}]" if size == 1 else f"[{first}..{first + size - 1}]"
            lines.append(f"  {place:<10} {name}{unit}")
            first += size
        return lines

    def list_actions(self) -> list[str]:
        """Return what the action means, with its bounds."""
        meaning, space = self.info.env.action_meaning or "as the environment takes it", self.action_space
        if not isinstance(space, spaces.Box):
            return [f"  {meaning}: {' '.join(str(space).split())}, counted from 0"]
        bounds = zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)
        ranges = [f"from {low:.6g} to {high:.6g}" for low, high in bounds]
        joints = self.info.env.joints
        if joints and len(joints.names) == len(ranges):
            ranges = [f"{name}, {each}" for name, each in zip(joints.names, ranges, strict=True)]
        elif len(set(ranges)) == 1:
            return [f"  {meaning}; each {ranges[0]}"]
        return [f"  {meaning}", *(f"  [{index}] {each}" for index, each in enumerate(ranges))]


def _write_header(name: str, info: PolicyInfo, layout: _Layout, members: list[str], prototype: str) -> str:
    upper = name.upper()
    control_dt = info.env.control_dt
    about = [
        f"{info.algo} policy for {info.spec.task} after {info.training_steps} steps. Written by rlctl "
        f"{__version__}; do not edit.",
        *([f"Robot: {info.env.robot}."] if info.env.robot else []),
        *([f"Call {name}_act every {control_dt!r} s."] if control_dt is not None else []),
        "",
        f"observation, {layout.size} elements, raw: normalisation is inside"
        + (f"; one observation, the last {layout.frames} are stacked inside" if layout.frames > 1 else ""),
        *layout.list_elements(),
        f"action, {format_count(layout.action_size, 'element')}",
        *layout.list_actions(),
        "",
        "Nothing is allocated, and nothing is shared between calls" + (" but the state." if members else "."),
        "A NaN in the observation gives NaN actions or an arbitrary choice: check what sensors say before.",
    ]
    declarations = [f"{prototype};"]
    if members:
        reset = f"/* Call it when an episode begins. */\nvoid {name}_reset({name}_state *state);"
        fields = "\n".join(f"    {each}" for each in members)
        declarations = [f"typedef struct {{\n{fields}\n}} {name}_state;", reset, *declarations]
    sizes = [f"#define {upper}_OBSERVATION_SIZE {layout.size}", f"#define {upper}_ACTION_SIZE {layout.action_size}"]
    if control_dt is not None:
        sizes.append(f"#define {upper}_CONTROL_DT {control_dt!r} /* [s] */")
    blocks = [
        f"#ifndef {upper}_H\n#define {upper}_H",
        "\n".join(sizes),
        '#ifdef __cplusplus\nextern "C" {\n#endif',
        *declarations,
        "#ifdef __cplusplus\n}\n#endif",
        "#endif",
    ]
    return "\n\n".join([_write_comment(about), *blocks]) + "\n"


def _write_comment(lines: list[str]) -> str:
    """Return a comment that ends where it is to end, whatever names a task has."""
    plain = [" ".join(line.split()) if line.lstrip() == line else line for line in lines]
    safe = [re.sub(r"[\r\n\v\f\0]", " ", line).replace("*/", "* /").replace("/*", "/ *").rstrip("\\") for line in plain]
    return "/* " + "\n".join(f" * {line}".rstrip() for line in safe)[3:] + "\n */"


def _write_source(name: str, info: PolicyInfo, writer: CWriter, prototype: str) -> str:
    reset = f"""void {name}_reset({name}_state *state)
{{
    static const {name}_state zeros;
    *state = zeros;
}}

"""
    body = "\n".join(f"    {line}" for line in writer.statements)
    parts = [
        f"{_write_comment([f'{info.algo} policy for {info.spec.task}; see the header.'])}\n",
        f'#include <math.h>\n\n#include "{name}.h"\n',
        *writer.constants,
        *writer.find_functions(),
        f"{reset if '*state' in prototype else ''}{prototype}\n{{\n{body}\n}}\n",
    ]
    return "\n".join(parts)


def _stack_frames(layout: _Layout) -> list[str]:
    if layout.frames == 1:
        return []
    size, total = layout.size, layout.frames * layout.size
    return [
        f"for (int i = 0; i < {total}; ++i) {{ /* the first observation of an episode fills all frames */",
        f"    const int older = state->begun && i < {total - size};",
        f"    state->frames[i] = older ? state->frames[i + {size}] : observation[i % {size}];",
        "}",
        "state->begun = 1;",
    ]


def find_compiler() -> list[str] | None:
    """Return the command of the C compiler, `$CC` or `cc`; None if there is none."""
    command = shlex.split(os.environ.get("CC", "")) or ["cc"]
    return command if shutil.which(command[0]) else None


def build_library(code: CSource, info: PolicyInfo, folder: Path, compiler: list[str]) -> Path:
    """Compile a policy in `folder` and return the library; raises `AnswerIsNo` if the compiler does not take it."""
    (folder / f"{code.name}.h").write_text(code.header)
    (folder / f"{code.name}.c").write_text(code.source)
    (folder / "harness.c").write_text(code.harness)
    library = folder / f"{code.name}{LIBRARY_SUFFIX}"
    library.with_suffix(".json").write_text(info.model_dump_json())
    command = [*compiler, *FLAGS, "-fPIC", "-shared", "-o", str(library), f"{code.name}.c", "harness.c", "-lm"]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise AnswerIsNo(f"{compiler[0]} cannot compile the policy: {short_repr(str(error))}") from None
    if done.returncode != 0:
        raise AnswerIsNo(f"{compiler[0]} cannot compile the policy: {short_repr(done.stderr, 300)}")
    return library
