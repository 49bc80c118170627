"""RL809: impossible or unreadable values in a URDF."""

from collections.abc import Iterator
from typing import Any

from rlctl.checking.experiments.worlds import judges_models
from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.values import is_task

RULE = Rule(
    "RL809",
    "impossible or unreadable values in a URDF",
    Severity.WARNING,
    meaning="""
        A link of a URDF that a task of rlctl loads has no <inertial>, and a joint moves nothing but it, so it
        gets a mass of 1 kg; or no solid of that mass and size has the inertia of the file, and other moments
        are used in its place; or a value is not a number, and PyBullet silently reads its first digits; or the
        limits of a revolute joint are in degrees; or a joint's lower limit is above its upper one, so that it
        has no limits; or the file of a visual mesh is missing, so that films do not show it. Such a body moves,
        or looks, as no real one does. Links lighter than a hundredth of their body are not judged. The info
        lists links without <inertial> that are frames, welded to others or with others beyond them: they weigh
        1 mg.
    """,
    fix="""
        Write mass and inertia of each link: of a box of mass m, ixx is m / 12 * (y^2 + z^2). For another
        author's file, load it with Sim.load(..., inertia="shape"); in PyBullet without rlctl, leave out
        URDF_USE_INERTIA_FROM_FILE. Write limits in radians, the lower one first, and copy missing meshes next
        to the model.
    """,
)


@judges_models(RULE)
def _find_faults_of_models(env: Any) -> Iterator[ChildMessage]:
    """Yield what is wrong with the model files of a task."""
    if not is_task(env):
        yield Skipped(RULE.id, "only the model files of tasks of rlctl are known", applies=False)
        return
    from rlctl.task.model_faults import find_frames, find_model_faults

    for body in env.unwrapped.sim.bodies.values():
        for fault in find_model_faults(body):
            yield RuleFinding(RULE, fault.rstrip("."))
        if frames := find_frames(body):
            yield RuleFinding(RULE, frames, severity=Severity.INFO)
