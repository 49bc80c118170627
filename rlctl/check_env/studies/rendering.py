"""Builds an instance per render mode that metadata promises, and asks it for a picture."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, get_args

import numpy as np

from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.failures import EnvironmentRaised, describe
from rlctl.check_env.instance import Instance
from rlctl.check_env.legacy import result
from rlctl.check_env.messages import Message
from rlctl.check_env.results import RenderAttempt, Rendering

Mode = Literal["rgb_array", "ansi"]
MODES: tuple[Mode, ...] = get_args(Mode)
"""Modes that open no window."""


def rendering(context: Context) -> Iterator[Message]:
    """Try each promised render mode on an instance of its own."""
    with context.fresh() as instance:
        promised = _promised(instance.env)
    yield result(Rendering([_attempt(context, mode) for mode in MODES if mode in promised]))


def _promised(env: Any) -> list[str]:
    metadata = getattr(env, "metadata", None)
    modes = metadata.get("render_modes") if isinstance(metadata, dict) else None
    return [str(mode) for mode in modes] if isinstance(modes, (list, tuple, set)) else []


def _attempt(context: Context, mode: Mode) -> RenderAttempt:
    doing = "build"
    try:
        with context.fresh(mode) as instance:
            doing = "render"
            return _judged(mode, _picture(instance))
    except EnvironmentRaised as error:
        cause = error.__cause__ or error
        problem = "missing" if _is_missing(cause) else "build" if error.call == "build" else doing
        return RenderAttempt(mode, problem, describe(cause))


def _picture(instance: Instance) -> Any:
    env = instance.env
    keywords = {"seed": FIRST_SEED} if instance.accepts_seed else {}
    instance.call("reset", env.reset, **keywords)
    return instance.call("render", env.render)


def _is_missing(error: BaseException | None) -> bool:
    """Say whether a library is missing: that is this machine's fault, not the environment's."""
    while error is not None:
        if isinstance(error, ImportError) or type(error).__name__ == "DependencyNotInstalled":
            return True
        error = error.__cause__
    return False


def _judged(mode: Mode, picture: Any) -> RenderAttempt:
    if mode == "ansi":
        # Gymnasium's API allows a string or a StringIO.
        fine = isinstance(picture, str) or hasattr(picture, "getvalue")
        return RenderAttempt(mode, "" if fine else "type", "" if fine else f"a {type(picture).__name__}")
    if not isinstance(picture, np.ndarray):
        return RenderAttempt(mode, "type", f"a {type(picture).__name__}")
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        return RenderAttempt(mode, "type", f"an array of {picture.dtype} and shape {picture.shape}")
    if picture.size and (picture == picture[0, 0]).all():
        colour = ", ".join(str(int(part)) for part in picture[0, 0])
        return RenderAttempt(mode, "plain", f"({colour})")
    return RenderAttempt(mode, "", "")
