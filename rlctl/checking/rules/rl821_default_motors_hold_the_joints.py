"""RL821: default motors hold the joints."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import JOINTS, Joint, WorldBody
from rlctl.environments.bullet_calls import BulletCalls

RULE = Rule(
    "RL821",
    "default motors hold the joints",
    Severity.ERROR,
    meaning="""
        Joints get torques in PyBullet and do not move. PyBullet gives each joint a motor when a model is loaded,
        which holds the joint still with up to an impulse of 1 per physics step, 240 N m at 240 Hz. TORQUE_CONTROL
        does not switch it off.
    """,
    fix="""
        Switch the motor of each joint off once after loading, setJointMotorControl2(robot, joint,
        p.VELOCITY_CONTROL, force=0), or give it the friction that the joint has.
    """,
    shows_one=True,
)

STILL = 0.05  # [rad], [m]: held joints give way by less, also where the robot hits something


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for world in watched.worlds:
        if world.world.engine == "PyBullet":
            yield from _find_held_joints(world, watched.calls)


def _find_held_joints(world: LoggedWorld, calls: BulletCalls) -> Iterator[RuleFinding]:
    """Yield joints that get torques, whose motors nothing has ever set, and that stay where they are."""
    held: list[tuple[WorldBody, Joint, float]] = []
    for body in world.world.bodies:
        for place, joint in enumerate(body.joints):
            key = world.world.client, body.id, joint.index
            if key in calls.torques and key not in calls.motorized:
                moved = max(_find_ranges(world, body, place), default=STILL)
                if moved < STILL:
                    held.append((body, joint, moved))
    if not held:
        return
    body, joint, moved = held[0]
    torque = calls.torques[world.world.client, body.id, joint.index]
    names = list_names([joint.name for _, joint, _ in held], 4)
    unit, force_unit = ("rad", "N m") if joint.is_angle else ("m", "N")
    what = f"{names} get torques, and PyBullet's default motors hold them"
    if len(held) == 1:
        what = f"{names} gets torques, and PyBullet's default motor holds it"
    message = f"{what}: with up to {torque.value:.3g} {force_unit}, {joint.name} moved {moved:.2g} {unit}"
    evidence = {"element": joint.name, "value": moved, "torque": torque.value}
    yield RuleFinding(RULE, message, evidence, where=(torque.call.file, torque.call.line))


def _find_ranges(world: LoggedWorld, body: WorldBody, place: int) -> Iterator[float]:
    """Yield how far a joint moved in each episode with steps [rad], [m]."""
    for log in world.logs:
        for logged, states in log.bodies:
            if logged.id == body.id and len(states) > 1:
                yield float(np.ptp(states[:, JOINTS + place]))
