"""A policy as C99: a header and a source file without dependencies, from the same graph as its ONNX file."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import onnx
from gymnasium import spaces

import rlctl
from rlctl.dict_spaces import SINGLE, split_space
from rlctl.errors import UsageError
from rlctl.export.c_expressions import Value, c_type, literal, name_array
from rlctl.export.c_translation import Translation, count_weights
from rlctl.run.c_policy import action_type, observation_type
from rlctl.run.onnx_policy import ACTION, SINGLE_INPUT, STATE_INPUTS, STATE_OUTPUTS
from rlctl.run.policy import PolicyInfo

LARGEST = 3_000_000
"""Weights that a C file may have: some 40 MB of text, which a compiler takes a minute for."""


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


def write_c(info: PolicyInfo, model: onnx.ModelProto, file_name: str) -> CSource:
    """Write a policy's graph as C; functions are called after the file, `reach.c` -> `reach_act`.

    Raises `UsageError` for what has no translation: images, and networks of more than `LARGEST` weights.
    """
    graph = model.graph
    if (weights := count_weights(graph)) > LARGEST:
        raise UsageError(
            f"export --c: {weights:,} weights are too many for a C file (at most {LARGEST:,}); rlctl export --onnx"
        )
    name = _make_identifier(file_name)
    layout = _Layout(info)
    state = _find_state_sizes(graph)
    translation = Translation(graph, {**layout.inputs(), **_find_state_values(state)})
    translation.assign("action", translation[ACTION])
    for member, output in zip(("hidden", "cell"), STATE_OUTPUTS if state else (), strict=False):
        translation.assign(f"state->{member}", translation[output])
    members = layout.state_members() + [f"float {member}[{size}];" for member, size in state.items()]
    state_argument = f"{name}_state *state, " if members else ""
    prototype = f"void {name}_act(const {layout.type} *observation, {state_argument}{layout.action_type} *action)"
    header = _write_header(name, info, layout, members, prototype)
    source = _write_source(name, info, layout, translation, prototype)
    return CSource(name, header, source, prototype, bool(members))


def _make_identifier(text: str) -> str:
    plain = re.sub(r"\W", "_", text, flags=re.ASCII)
    return plain if re.match(r"[A-Za-z]", plain) else f"policy{plain if plain.startswith('_') else f'_{plain}'}"


def _find_state_sizes(graph: onnx.GraphProto) -> dict[str, int]:
    shapes = {each.name: [size.dim_value for size in each.type.tensor_type.shape.dim] for each in graph.input}
    found = [shapes[name] for name in STATE_INPUTS if name in shapes]
    return {member: shape[0] * shape[2] for member, shape in zip(("hidden", "cell"), found, strict=False)}


def _find_state_values(state: dict[str, int]) -> dict[str, Value]:
    inputs = zip(STATE_INPUTS, state.items(), strict=False)
    return {name: name_array(f"state->{member}", np.float32, size) for name, (member, size) in inputs}


class _Layout:
    """Which element of the C function's observation is what."""

    def __init__(self, info: PolicyInfo) -> None:
        self.info = info
        space, self.action_space = info.env.spaces()
        self.frames = info.spec.frame_stack
        self.parts = split_space(space)
        if self.frames > 1 and len(space.shape or ()) != 1:
            raise UsageError("export --c: images cannot be written as C; rlctl export --onnx can")
        self.sizes = {key: math.prod(part.shape or ()) for key, part in self.parts.items()}
        self.size = sum(self.sizes.values()) // self.frames
        self.type = c_type(observation_type(info))
        self.action_type = c_type(action_type(info))
        self.action_size = math.prod(self.action_space.shape or ())

    def inputs(self) -> dict[str, Value]:
        """Return the graph's inputs, as parts of the observation or of the stacked frames."""
        source = "state->frames" if self.frames > 1 else "observation"
        found, offset = {}, 0
        for key, part in self.parts.items():
            array = name_array(source, observation_type(self.info), self.sizes[key], offset)
            found[key or SINGLE_INPUT] = self._read(array, part)
            offset += self.sizes[key]
        return found

    def _read(self, array: Value, part: spaces.Space[object]) -> Value:
        dtype = np.dtype(part.dtype)
        if c_type(dtype) == array.type:
            return Value(array.element, dtype, array.size, array.name)
        return Value(lambda i: f"({c_type(dtype)}){array.element(i)}", dtype, array.size)

    def state_members(self) -> list[str]:
        """Return the part of the state that remembers earlier observations."""
        if self.frames == 1:
            return []
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
        f"{rlctl.__version__}; do not edit.",
        f"Robot: {info.env.robot}." if info.env.robot else "",
        f"Call {name}_act every {control_dt!r} s." if control_dt is not None else "",
        "",
        f"observation, {layout.size} elements, raw: normalisation is inside"
        + (f"; one observation, the last {layout.frames} are stacked inside" if layout.frames > 1 else ""),
        *layout.list_elements(),
        f"action, {layout.action_size} element{'s' if layout.action_size > 1 else ''}",
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
        sizes.append(f"#define {upper}_CONTROL_DT {literal(control_dt, np.float64)} /* [s] */")
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
    plain = [" ".join(line.split()) if line.lstrip() == line else line for line in lines if line is not None]
    safe = [re.sub(r"[\r\n\v\f\0]", " ", line).replace("*/", "* /").replace("/*", "/ *").rstrip("\\") for line in plain]
    return "/* " + "\n".join(f" * {line}".rstrip() for line in safe)[3:] + "\n */"


def _write_source(name: str, info: PolicyInfo, layout: _Layout, translation: Translation, prototype: str) -> str:
    reset = f"""void {name}_reset({name}_state *state)
{{
    static const {name}_state zeros;
    *state = zeros;
}}

"""
    statements = [*_stack_frames(layout), *translation.statements]
    body = "\n".join(f"    {line}" for line in statements)
    parts = [
        f"{_write_comment([f'{info.algo} policy for {info.spec.task}; see the header.'])}\n",
        f'#include <math.h>\n\n#include "{name}.h"\n',
        *translation.constants,
        *translation.find_helpers(),
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
