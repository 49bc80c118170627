"""The experiment `turned`: turns a free robot about the vertical, for rules about headings.

Nothing but its heading is another one then: on level ground the robot moves as before, in another direction.
"""

import dataclasses
import functools
import sys
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.bullet_worlds import read_world
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.mujoco_worlds import FREE
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rewards import TERMS
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.transitions import flatten_floats
from rlctl.checking.values import find_numbers
from rlctl.environments.bullet_clients import ClientCalls
from rlctl.environments.simulations import find_mujoco
from rlctl.task.rotations import from_axis, multiply, roll_pitch_yaw, rotate

PLANE = 0  # MuJoCo's type of a geom
UP = (0.0, 0.0, 1.0)
ENDLESS = 100.0  # [m]; the box of PyBullet's plane.urdf has 200 m, and its planes are larger
LEVEL = 0.02  # how far static bodies may be above the lowest point of a robot [m]
PUSHES, PUSHED_ANGLE, PUSHED_LIFT = 2, 1.3, 0.1  # actions that are tried, [rad], [m]
LEAST_PUSH, PUSH_ERROR = 1e-4, 0.1  # [m/s], part of a push
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class TurnedStep:
    """What the first step returned."""

    heading: float  # of the robot before it, from the engine [rad]
    observed: Numbers  # The numbers that are floats. Shape (elements,)
    reward: float  # NaN where it is no number
    terms: Mapping[str, float]  # of the reward, by name; empty where info has none
    velocity: complex  # level, in the frame of the world, from the engine: x + y j [m/s]


@dataclasses.dataclass(frozen=True)
class TurnedRobot:
    """An instance whose only free robot can be turned."""

    instance: Instance

    @functools.cached_property
    def pushes_itself(self) -> bool:
        """Whether what moves the robot turns with it: its joints, or the force of an action."""
        return self._has_joints() or all(self._is_pushed_along(number) for number in range(PUSHES))

    def _has_joints(self) -> bool:
        if (simulation := find_mujoco(self.instance.env)) is not None:
            return bool((simulation[0].jnt_type != FREE).any())
        return any(body.is_free and body.joints for c in self.instance.find_clients() for body in read_world(c).bodies)

    def _is_pushed_along(self, number: int) -> bool:
        """Say whether an action pushes the robot in a direction that turns with it."""
        pushes = list[complex]()
        for angle in (0.0, PUSHED_ANGLE):
            zero, pushed = (self.play(number, angle, lift=PUSHED_LIFT, actions=kind) for kind in ("zero", "repeated"))
            if zero is None or pushed is None:
                return False
            pushes.append(pushed.velocity - zero.velocity)
        before, after = pushes
        return abs(before) > LEAST_PUSH and abs(after * np.exp(-1j * PUSHED_ANGLE) - before) < PUSH_ERROR * abs(before)

    def play(
        self,
        number: int,
        angle: float,
        speed: float = 0.0,
        lift: float = 0.0,
        spin: float = 0.0,
        actions: str = "zero",
    ) -> TurnedStep | None:
        """Reset with a seed, turn the robot by an angle [rad] about the vertical, lift it [m], let it move forwards at
        a speed [m/s] and roll at a rate [rad/s], and take a step; None where time is over."""
        if self.instance.context.budget.is_over():
            return None
        player = EpisodePlayer(self.instance, FIRST_SEED + number, actions, max_steps=1)
        player.reset()
        heading = _turn(self.instance, angle, speed, lift, spin)
        moment = player.step()
        observed = flatten_floats(self.instance.leaves, moment.observation)
        numbers = find_numbers(moment.info) if isinstance(moment.info, dict) else ()
        terms = {name.removeprefix(TERMS): value for name, value in numbers if name.startswith(TERMS)}
        return TurnedStep(heading, observed, moment.reward_number, terms, _read_velocity(self.instance))


judges_turned = JudgeHook[TurnedRobot]()
"""Shows a robot on level ground that the parts turn."""


@experiment("turned", PROBE, 112, share=0.5, hooks=(judges_turned,), seeds_globals=True, alters=True)
def turn_robot(context: Context) -> Iterator[ChildMessage]:
    """Find a free robot on level ground, and let the rules turn it."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    EpisodePlayer(instance, FIRST_SEED, max_steps=0).reset()
    if not _can_turn(instance):
        raise NotApplicable("no robot with a free base on level ground, in PyBullet or MuJoCo")
    robot = TurnedRobot(instance)
    robot.play(0, 0.0)  # an instance's first episode may differ from all others
    yield from judges_turned.judge(robot)


def _can_turn(instance: Instance) -> bool:
    if (simulation := find_mujoco(instance.env)) is not None:
        return _is_level(*simulation)
    return len(_find_free_bodies(instance.find_clients())) == 1


def _is_level(model: Any, data: Any) -> bool:
    """Say whether all of the world is level planes, and one robot is free."""
    sys.modules["mujoco"].mj_kinematics(model, data)  # reset may only write qpos
    is_static = model.body_weldid == 0
    touches = (model.geom_contype | model.geom_conaffinity).astype(bool)
    touches[np.concatenate([model.pair_geom1, model.pair_geom2])] = True  # Some models list pairs instead.
    static = np.flatnonzero(is_static[model.geom_bodyid] & touches)
    is_plane = all(model.geom_type[geom] == PLANE and data.geom_xmat[geom][8] > 1 - 1e-9 for geom in static)
    roots = {int(root) for root in model.body_rootid[~is_static]}
    return is_plane and len(roots) == 1 and int((model.jnt_type == FREE).sum()) == 1


def _find_free_bodies(clients: Iterable[int]) -> list[tuple[ClientCalls, int]]:
    """Return the free bodies of PyBullet; none where something static is higher than the lowest point of one."""
    found: list[tuple[ClientCalls, int]] = []
    tops: list[float] = []
    for client in clients:
        p = ClientCalls(client)
        for body in read_world(client).bodies:
            if body.is_free:
                found.append((p, body.id))
            elif not _is_level_plane(p, body.id):
                tops += [p.getAABB(body.id, link)[1][2] for link in range(-1, len(body.links) - 1)]
    for p, body_id in found:
        lowest = min(p.getAABB(body_id, link)[0][2] for link in range(-1, p.getNumJoints(body_id)))
        if tops and max(tops) > lowest + LEVEL:
            return []
    return found


def _require_free_body(instance: Instance) -> tuple[ClientCalls, int]:
    """Return the free body of PyBullet; raises `NotJudged` where another reset has put it beside something higher."""
    found = _find_free_bodies(instance.find_clients())
    if not found:
        raise NotJudged("not each reset puts the robot on level ground")
    return found[0]


def _is_level_plane(p: ClientCalls, body: int) -> bool:
    """Say whether a body of PyBullet is a plane or a box that goes on as far as any robot, and not tilted."""
    low, high = p.getAABB(body)
    if min(high[0] - low[0], high[1] - low[1]) <= ENDLESS:
        return False  # of some capsules of MJCF files PyBullet dies when it is asked for their shape
    _, orientation = p.getBasePositionAndOrientation(body)
    is_flat = {shape[2] for shape in p.getCollisionShapeData(body, -1)} <= {p.GEOM_PLANE, p.GEOM_BOX}
    return is_flat and bool(rotate(orientation, UP)[2] > 1 - 1e-9)


def _turn(instance: Instance, angle: float, speed: float, lift: float, spin: float) -> float:
    """Turn the free robot about the vertical, lift it, and change its velocities; return its heading [rad]."""
    if (simulation := find_mujoco(instance.env)) is not None:
        return _turn_in_mujoco(*simulation, angle, speed, lift, spin)
    p, body = _require_free_body(instance)
    place, orientation = p.getBasePositionAndOrientation(body)
    linear, angular = p.getBaseVelocity(body)
    turn = from_axis(UP, angle)
    turned = multiply(turn, np.array(orientation))
    heading = roll_pitch_yaw(turned.tolist())[2]
    p.resetBasePositionAndOrientation(body, (*place[:2], place[2] + lift), turned.tolist())
    forwards = np.array([np.cos(heading), np.sin(heading), 0.0])
    velocity, rate = rotate(turn, linear) + speed * forwards, rotate(turn, angular) + spin * forwards
    p.resetBaseVelocity(body, velocity.tolist(), rate.tolist())
    return float(heading)


def _turn_in_mujoco(model: Any, data: Any, angle: float, speed: float, lift: float, spin: float) -> float:
    (joint,) = np.flatnonzero(model.jnt_type == FREE)
    place, first = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    turn = from_axis(UP, angle)
    turned = multiply(turn, np.roll(data.qpos[place + 3 : place + 7], -1))
    heading = roll_pitch_yaw(turned.tolist())[2]
    data.qpos[place + 3 : place + 7] = np.roll(turned, 1)
    data.qpos[place + 2] += lift
    data.qvel[first : first + 3] = rotate(turn, data.qvel[first : first + 3])
    data.qvel[first : first + 2] += speed * np.array([np.cos(heading), np.sin(heading)])
    data.qvel[first + 3] += spin  # in the frame of the body
    sys.modules["mujoco"].mj_forward(model, data)
    return float(heading)


def _read_velocity(instance: Instance) -> complex:
    """Return the velocity of the free robot in the plane [m/s]."""
    if (simulation := find_mujoco(instance.env)) is not None:
        model, data = simulation
        (joint,) = np.flatnonzero(model.jnt_type == FREE)
        x, y = data.qvel[model.jnt_dofadr[joint] :][:2]
    else:
        p, body = _require_free_body(instance)
        x, y, _ = p.getBaseVelocity(body)[0]
    return complex(x, y)
