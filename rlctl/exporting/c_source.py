"""A policy as C99: a header and a source file without dependencies."""

import dataclasses
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

from gymnasium import spaces

from rlctl.errors import AnswerIsNo, UsageError, short_repr
from rlctl.exporting.c_header import Layout
from rlctl.exporting.c_layers import CWriter, write_array
from rlctl.policy import own_modules
from rlctl.policy.c_policy import LIBRARY_SUFFIX
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.layers import ScaleImage
from rlctl.policy.network import Network
from rlctl.version import __version__

LARGEST = 3_000_000  # most weights in a C file: about 40 MB of text, for which a compiler needs a minute
FLAGS = ("-std=c99", "-O3", "-Wall", "-Wextra", "-pedantic")
_TIMEOUT_S = 300.0  # of a compiler


@dataclasses.dataclass(frozen=True)
class CSource:
    """The content of a C header and its source file."""

    name: str  # prefix of all names in the header
    header: str
    source: str
    prototype: str  # declaration of the function that acts
    harness: str  # C functions with the same names for every policy, for calls through ctypes


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
    value, size = writer.write(network, layout.sizes, "state->frames" if layout.frames > 1 else "observation")
    writer.write_action(network, value, size, layout.action_space, layout.action_type)
    state = []
    if layout.frames > 1:
        state += [f"{layout.type} frames[{layout.frames * layout.size}]; /* oldest first */", "int begun;"]
    if network.lstm is not None:
        state += [f"float {member}[{network.lstm.state[0].size}];" for member in ("hidden", "cell")]
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
        "functions": writer.find_functions(),
        "statements": writer.statements,
    }
    header, source, harness = (_render(file, values) for file in ("policy.h", "policy.c", "harness.c"))
    return CSource(name, header, source, values["prototype"], harness)


def _render(file: str, values: dict[str, Any]) -> str:
    import jinja2

    environment = jinja2.Environment(
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["comment"] = _write_comment
    environment.globals["write_array"] = write_array
    return environment.from_string(Path(__file__).with_name(f"{file}.jinja").read_text(encoding="utf-8")).render(values)


def _write_comment(text: str) -> str:
    """Return a C comment; names of a task cannot end it early."""
    plain = [" ".join(line.split()) if line.lstrip() == line else line for line in text.strip().split("\n")]
    safe = [re.sub(r"[\r\v\f\0]", " ", line).replace("*/", "* /").replace("/*", "/ *").rstrip("\\") for line in plain]
    return "/* " + "\n".join(f" * {line}".rstrip() for line in safe)[3:] + "\n */"


def _make_identifier(text: str) -> str:
    plain = re.sub(r"\W", "_", text, flags=re.ASCII)
    return plain if re.match(r"[A-Za-z]", plain) else f"policy{plain if plain.startswith('_') else f'_{plain}'}"


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
