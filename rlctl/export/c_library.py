"""Compiles an exported C file into a shared library, if this machine has a compiler."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path

from rlctl.errors import AnswerIsNo, short_repr
from rlctl.export.c_source import CSource
from rlctl.run.c_policy import LIBRARY_SUFFIX
from rlctl.run.policy import PolicyInfo

_TIMEOUT_S = 300.0
FLAGS = ("-std=c99", "-O3", "-Wall", "-Wextra", "-pedantic")


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
