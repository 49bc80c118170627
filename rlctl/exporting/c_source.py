"""A policy as C99: a header and a source file without dependencies."""

from __future__ import annotations

import dataclasses
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

from gymnasium import spaces

from rlctl.errors import AnswerIsNo, UsageError, short_repr
from rlctl.exporting.c_header import Layout, write_comment, write_data, write_header
from rlctl.exporting.c_layers import CWriter
from rlctl.policy import own_modules
from rlctl.policy.c_policy import LIBRARY_SUFFIX
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.layers import ScaleImage
from rlctl.policy.network import Network

LARGEST = 3_000_000
"""Most weights in a C file: about 40 MB of text, for which a compiler needs a minute."""
FLAGS = ("-std=c99", "-O3", "-Wall", "-Wextra", "-pedantic")
_TIMEOUT_S = 300.0  # of a compiler


@dataclasses.dataclass(frozen=True)
class CSource:
    """The content of a C header and its source file."""

    name: str
    """Prefix of all names in the header."""
    header: str
    source: str
    prototype: str
    """Declaration of the function that acts."""
    has_state: bool

    @property
    def harness(self) -> str:
        """Return C functions with the same names for every policy, for calls through ctypes."""
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
    """Write a policy as C; names of functions begin with the name of the file: `reach.c` -> `reach_act`.

    Raises `UsageError` for images, a user's own network, and networks of more than `LARGEST` weights.
    """
    if (weights := sum(tensor.size for tensor in policy.actor_only().tensors.values())) > LARGEST:
        raise UsageError(
            f"export --c: {weights:,} weights are too many for a C file (at most {LARGEST:,}); use export --onnx"
        )
    kwargs = policy.info.policy_kwargs
    for key in own_modules.KEYS:
        if isinstance(own := kwargs.get(key), dict):
            raise UsageError(
                f"export --c: the layer {own['class']} of policy_kwargs.{key} cannot be written as C; use export --onnx"
            )
    name, network = _make_identifier(file_name), Network(policy)
    layout = Layout(name, policy.info)
    has_images = any(isinstance(layer, ScaleImage) for part in network.parts.values() for layer in part)
    if has_images or (layout.frames > 1 and [len(part.shape or ()) for part in layout.parts.values()] != [1]):
        raise UsageError("export --c: networks for images cannot be written as C; use export --onnx")
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
    header = write_header(layout, members, prototype)
    source = _write_source(layout, writer, prototype)
    return CSource(name, header, source, prototype, bool(members))


def _make_identifier(text: str) -> str:
    plain = re.sub(r"\W", "_", text, flags=re.ASCII)
    return plain if re.match(r"[A-Za-z]", plain) else f"policy{plain if plain.startswith('_') else f'_{plain}'}"


def _write_source(layout: Layout, writer: CWriter, prototype: str) -> str:
    name, info = layout.name, layout.info
    reset = f"""void {name}_reset({name}_state *state)
{{
    static const {name}_state zeros;
    *state = zeros;
}}

"""
    body = "\n".join(f"    {line}" for line in writer.statements)
    parts = [
        f"{write_comment([f'{info.algo} policy for {info.spec.task}; see the header.'])}\n",
        f'#include <math.h>\n\n#include "{name}.h"\n',
        *write_data(layout),
        *writer.constants,
        *writer.find_functions(),
        f"{reset if '*state' in prototype else ''}{prototype}\n{{\n{body}\n}}\n",
    ]
    return "\n".join(parts)


def _stack_frames(layout: Layout) -> list[str]:
    if layout.frames == 1:
        return []
    size, total = layout.size, layout.frames * layout.size
    return [
        f"for (int i = 0; i < {total}; ++i) {{ /* the first observation of an episode is copied into all frames */",
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
    """Compile a policy in `folder` and return the library; raises `AnswerIsNo` if the compiler fails."""
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
