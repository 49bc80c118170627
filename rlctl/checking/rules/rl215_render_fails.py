"""RL215: render fails."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.checking.experiment import INSTANCES, experiment, judges_records
from rlctl.checking.instance import Context, EnvironmentRaised, find_missing_file, get_causes
from rlctl.checking.records import FIRST_SEED, ChildMessage, Records
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.errors import RecipeError, UsageError

RULE = Rule(
    "RL215",
    "render fails",
    Severity.WARNING,
    meaning="""
        metadata promises a render mode that does not work. Videos of the policy fail, often after a long
        training.
    """,
    fix="""
        Take render_mode in the constructor, keep it as self.render_mode, and return what it promises; or leave
        the mode out of metadata["render_modes"]. Render without a display: with MuJoCo set MUJOCO_GL=egl (or
        osmesa), with pygame SDL_VIDEODRIVER=dummy; with PyBullet use
        getCameraImage(renderer=p.ER_TINY_RENDERER).
    """,
)

PICTURE = "a uint8 array of shape (height, width, 3)"  # What `render` returns in the mode rgb_array
NO_GRAPHICS = re.compile(r"OpenGL|\bEGL\b|OSMesa|GLFW|X11|display", re.IGNORECASE)  # raised without graphics


@experiment("rendering", INSTANCES, 100, RULE)
def render(context: Context) -> Iterator[ChildMessage]:
    """Try the mode rgb_array, which opens no window, on an instance of its own, where it is promised."""
    with context.fresh() as instance:
        metadata = getattr(instance.env, "metadata", None)
        modes = metadata.get("render_modes") if isinstance(metadata, dict) else None
        if not isinstance(modes, (list, tuple, set)) or "rgb_array" not in modes:
            raise NotApplicable(f"metadata does not list the render mode rgb_array (render_modes: {modes})")
        instance.reset(FIRST_SEED)  # What fails without rendering, too, is RL207.
    try:
        with context.fresh("rgb_array") as instance:
            instance.reset(FIRST_SEED)
            picture = instance.call("render", instance.env.render)
    except EnvironmentRaised as error:
        if find_missing_file(error.cause) is not None:
            raise NotJudged("a file that the environment loads is missing (RL007)") from None
        if error.call == "reset" and not instance.accepts_seed:
            raise NotJudged("reset takes no seed (RL202)") from None
        raised = str(error)
        causes = get_causes(error.cause)
        if any(isinstance(e, ImportError) or type(e).__name__ == "DependencyNotInstalled" for e in causes):
            raise NotJudged(f"a library that rendering needs is not installed: {raised}") from None
        if isinstance(error.cause, UsageError) and not isinstance(error.cause, RecipeError):
            raise NotJudged(
                str(error.cause).splitlines()[0]
            ) from None  # rlctl draws the world of a task, not its author
        call = "the constructor" if error.call == "build" else error.call
        message = f"with render_mode='rgb_array' {call} raises {raised}"
        if isinstance(error.cause, RecipeError):  # the constructor was not even called
            message = f"metadata lists the render mode rgb_array, but {error.cause}"
        severity = Severity.INFO if NO_GRAPHICS.search(raised) else None
        yield RuleFinding(RULE, message, {"value": raised, "expected": PICTURE}, severity)
        return
    if wrong := _describe_wrong_picture(picture):
        message = f"with render_mode='rgb_array' render returns {wrong}, not {PICTURE}"
        is_rgba = isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.shape[2:] == (4,)
        yield RuleFinding(RULE, message, {"value": wrong, "expected": PICTURE}, Severity.INFO if is_rgba else None)


def _describe_wrong_picture(picture: Any) -> str:
    if not isinstance(picture, np.ndarray):
        return f"a {type(picture).__name__}"
    fine = picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
    return "" if fine else f"an array of {picture.dtype} and shape {picture.shape}"


@judges_records(RULE, "rendering")
def _find_end_in_rendering(records: Records) -> Iterator[RuleFinding]:
    for failure in records.failures:
        if failure.phase == "rendering" and failure.kind in ("died", "hung"):
            yield RuleFinding(RULE, f"rendering without a window: {failure.message}", failure.place, Severity.ERROR)
