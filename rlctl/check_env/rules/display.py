"""RL2, pictures: `render` does what metadata promises, and no window opens unasked."""

from __future__ import annotations

import re
from collections.abc import Iterator

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import NotApplicable, NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import RenderAttempt, Rendering, Windows
from rlctl.check_env.rules.interface import where
from rlctl.check_env.rules.known import NO_DISPLAY, built, lost_display, result

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

EXPECTED = {"rgb_array": "a uint8 array of shape (height, width, 3)", "ansi": "a str"}

NO_GRAPHICS = re.compile(r"OpenGL|\bEGL\b|OSMesa|GLFW|X11|display", re.IGNORECASE)
"""What is said where this machine has no graphics: whether it works elsewhere is not known."""
NO_GRAPHICS_FIX = (
    "Render without a display: with MuJoCo set MUJOCO_GL=egl (or osmesa), with pygame SDL_VIDEODRIVER=dummy; with "
    "PyBullet use getCameraImage(renderer=p.ER_TINY_RENDERER)."
)


@rule(
    "RL215",
    "render fails",
    WARNING,
    "Take render_mode in the constructor, keep it as self.render_mode, and return what it promises; or leave the mode "
    'out of metadata["render_modes"].',
    needs=("rendering",),
)
def rendering(evidence: Evidence) -> Iterator[Seen]:
    """metadata promises a render mode that does not work. Videos of the policy fail, often at the end of a long
    training."""
    known = built(evidence)
    ended = [each for each in evidence.failures if each.phase == "rendering" and each.kind in ("died", "hung")]
    for failure in ended:
        how = f"ends the process: it {failure.error}" if failure.kind == "died" else failure.error
        yield Seen(f"rendering without a window: {failure.call} {how}", where(failure), ERROR)
        return
    attempts = result(evidence, Rendering, "rendering").attempts
    if not attempts:
        promised = known.metadata.get("render_modes") or "none"
        raise NotApplicable(f"promises no render mode that needs no window ({promised})")
    for attempt in attempts:
        if attempt.problem == "missing":
            raise NotJudged(f"a library that rendering needs is not installed: {attempt.text}")
        if attempt.problem:
            yield _failed(attempt)


def _failed(attempt: RenderAttempt) -> Seen:
    evidence = {"mode": attempt.mode, "value": attempt.text, "expected": EXPECTED[attempt.mode]}
    mode = f"render_mode={attempt.mode!r}"
    if attempt.problem == "plain":
        return Seen(f"with {mode} the picture after reset is all of one colour, {attempt.text}", evidence, INFO)
    if attempt.problem == "type":
        return Seen(f"with {mode} render returns {attempt.text}, not {EXPECTED[attempt.mode]}", evidence)
    call = {"build": "the constructor", "render": "render"}[attempt.problem]
    message = f"with {mode} {call} raises {attempt.text}"
    if NO_GRAPHICS.search(attempt.text):
        return Seen(message, evidence, INFO, NO_GRAPHICS_FIX)
    return Seen(message, evidence)


@rule(
    "RL216",
    "opens a window",
    ERROR,
    'Open windows for render_mode="human" only: p.connect(p.GUI if render_mode == "human" else p.DIRECT).',
    needs=("attributes",),
)
def opens_window(evidence: Evidence) -> Iterator[Seen]:
    """It opens a window although no render mode was asked for. On a server without a display that ends the process;
    elsewhere dozens of windows slow training down."""
    for failure in evidence.failures:
        if lost_display(failure):
            line = next(line for line in (failure.details or "").splitlines() if NO_DISPLAY.search(line)).strip()
            doing = {"load": "the import", "build": "the constructor"}.get(failure.call, failure.call)
            yield Seen(f"the process {failure.error} in {doing}, for want of a display: {line!r}", where(failure))
            return
    built(evidence)
    clients = result(evidence, Windows, "attributes").gui_clients
    if clients:
        yield Seen("PyBullet was connected with a window (p.GUI)", {"value": "GUI", "expected": "DIRECT"})
