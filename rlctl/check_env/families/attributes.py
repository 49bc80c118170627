"""RL2, what other code reads from an environment: attributes, spaces, pictures; and windows that nobody asked for."""

from __future__ import annotations

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.check_env.bullet_worlds import find_clients
from rlctl.check_env.experiment import RECORDING, check, experiment
from rlctl.check_env.failures import (
    NO_DISPLAY,
    EnvironmentRaised,
    describe,
    find_missing_file,
    iterate_causes,
    lacks_display,
)
from rlctl.check_env.families.interface import RENDERING
from rlctl.check_env.finding import Finding, NotApplicable, NotJudged, Severity
from rlctl.check_env.instance import Context
from rlctl.check_env.messages import FIRST_SEED, Fact, Message, Skipped
from rlctl.check_env.records import Records

PICTURE = "a uint8 array of shape (height, width, 3)"
"""What `render` returns in the mode rgb_array."""
NO_GRAPHICS = re.compile(r"OpenGL|\bEGL\b|OSMesa|GLFW|X11|display", re.IGNORECASE)
"""What is raised where this machine has no graphics: whether it works elsewhere is not known."""
NO_GRAPHICS_FIX = (
    "Render without a display: with MuJoCo set MUJOCO_GL=egl (or osmesa), with pygame SDL_VIDEODRIVER=dummy; with "
    "PyBullet use getCameraImage(renderer=p.ER_TINY_RENDERER)."
)


@experiment("attributes", "RL404", "RL216")
def read_attributes(context: Context) -> Iterator[Message]:
    """Read one instance that was reset, and a second one beside it."""
    with context.fresh() as instance:
        if _count_windows():
            evidence = {"value": "GUI", "expected": "DIRECT"}
            yield Finding("RL216", "PyBullet was connected with a window (p.GUI)", evidence)
        instance.reset(FIRST_SEED)
        yield Fact("truncation", read_truncation(getattr(instance.env, "unwrapped", instance.env)))
        if not instance.is_env:
            yield Skipped("RL404", "it is not a gymnasium.Env (RL003)")
            return
        with context.fresh() as other:
            yield from _shared_spaces(instance.env, other.env)


def _count_windows() -> int:
    pybullet = sys.modules.get("pybullet")
    if pybullet is None:
        return 0
    methods = [pybullet.getConnectionInfo(physicsClientId=each)["connectionMethod"] for each in find_clients()]
    return methods.count(pybullet.GUI)


def _shared_spaces(one: Any, other: Any) -> Iterator[Finding]:
    shared = []
    for name in ("action_space", "observation_space"):
        first, again, others = (getattr(each, name, None) for each in (one, one, other))
        if first is not again:
            yield _of_spaces([name], f"{name} is a new object each time it is read, so that seeding it has no effect")
        elif first is others is not None:
            shared.append(name)
    if shared:
        yield _of_spaces(shared, f"two instances have one object as {' and '.join(shared)}")


def _of_spaces(names: list[str], message: str) -> Finding:
    # Nobody samples observations.
    severity = Severity.WARNING if "action_space" in names else Severity.INFO
    return Finding("RL404", message, {"value": names, "expected": []}, severity)


def read_truncation(env: Any) -> str:
    """Return what the code of `step` says of `truncated`: `never` (always False), `computed`, or `unknown`."""
    try:
        nodes = list(ast.walk(ast.parse(textwrap.dedent(inspect.getsource(type(env).step)))))
    except (AttributeError, OSError, TypeError, SyntaxError):
        return "unknown"
    returned = [node.value for node in nodes if isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple)]
    flags = [ast.unparse(each.elts[3]) for each in returned if len(each.elts) == 5]
    assigned: dict[str, set[str]] = {}
    for node in nodes:
        if isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                assigned.setdefault(ast.unparse(target), set()).add(ast.unparse(node.value))
    if not flags:
        return "unknown"
    return "never" if all(assigned.get(flag, {flag}) == {"False"} for flag in flags) else "computed"


@experiment(RENDERING, "RL215")
def render(context: Context) -> Iterator[Message]:
    """Try the mode rgb_array, which opens no window, on an instance of its own, where it is promised."""
    with context.fresh() as instance:
        metadata = getattr(instance.env, "metadata", None)
    modes = metadata.get("render_modes") if isinstance(metadata, dict) else None
    if not isinstance(modes, (list, tuple, set)) or "rgb_array" not in modes:
        raise NotApplicable(f"metadata does not promise the render mode rgb_array (render_modes: {modes})")
    try:
        with context.fresh("rgb_array") as instance:
            instance.reset(FIRST_SEED)
            picture = instance.call("render", instance.env.render)
    except EnvironmentRaised as error:
        cause = error.__cause__ or error
        if find_missing_file(cause) is not None:
            raise NotJudged("a file that the environment loads is missing (RL007)") from None
        if _lacks_library(cause):
            raise NotJudged(f"a library that rendering needs is not installed: {describe(cause)}") from None
        call = "the constructor" if error.call == "build" else error.call
        message = f"with render_mode='rgb_array' {call} raises {describe(cause)}"
        is_here = NO_GRAPHICS.search(describe(cause)) is not None
        severity, fix = (Severity.INFO, NO_GRAPHICS_FIX) if is_here else (None, "")
        yield Finding("RL215", message, {"value": describe(cause), "expected": PICTURE}, severity, fix)
        return
    if wrong := _describe_wrong_picture(picture):
        message = f"with render_mode='rgb_array' render returns {wrong}, not {PICTURE}"
        yield Finding("RL215", message, {"value": wrong, "expected": PICTURE})


def _lacks_library(error: BaseException) -> bool:
    """Say whether a library is missing: that is this machine's fault, not the environment's."""
    return any(
        isinstance(e, ImportError) or type(e).__name__ == "DependencyNotInstalled" for e in iterate_causes(error)
    )


def _describe_wrong_picture(picture: Any) -> str:
    if not isinstance(picture, np.ndarray):
        return f"a {type(picture).__name__}"
    fine = picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
    return "" if fine else f"an array of {picture.dtype} and shape {picture.shape}"


@check("RL215", RENDERING)
def _find_end_in_rendering(records: Records) -> Iterator[Finding]:
    for failure in records.failures:
        if failure.phase == RENDERING and failure.kind in ("died", "hung"):
            yield Finding("RL215", f"rendering without a window: {failure.message}", failure.place, Severity.ERROR)


@check("RL216", *RECORDING)
def _find_lost_display(records: Records) -> Iterator[Finding]:
    for failure in records.failures:
        if lacks_display(failure):
            line = next(line for line in (failure.details or "").splitlines() if NO_DISPLAY.search(line)).strip()
            yield Finding("RL216", f"{failure.message}, for want of a display: {line!r}", failure.place)
            return
    records.require_built()
