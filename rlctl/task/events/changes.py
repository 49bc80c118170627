"""Functions of events: they change the world, or add noise and delay to observations and actions.

Each draws values from its ranges and returns them. Changes of a body start from its nominal values.
"""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np

from rlctl.errors import TaskError
from rlctl.task.camera import SHAPES, Distractor, ShapeName
from rlctl.task.events.event import (
    Drawn,
    Fraction,
    NotNegative,
    ObservationParts,
    Positive,
    Range,
    RangeLimits,
    Signal,
    Steps,
    acts_at,
)
from rlctl.task.events.world_signals import WORLD_SIGNALS, WorldDelay, WorldNoise, in_one_world
from rlctl.task.sim import Sim

Rng = np.random.Generator
Elevation = Annotated[Range, RangeLimits(0.0, 90.0)]  # [degrees]


@acts_at("reset", "start", "interval", factor=1.0)
def scale_mass(sim: Sim, rng: Rng, *, body: str, factor: Positive, links: Sequence[str] = ()) -> Drawn:
    """Scale the mass and inertia of `links`, or of the whole body, by one factor."""
    drawn = float(rng.uniform(*factor))
    sim.body(body).scale_mass(drawn, links)
    return {"factor": drawn}


@acts_at("reset", "start", "interval")
def set_friction(sim: Sim, rng: Rng, *, body: str, friction: NotNegative, links: Sequence[str] = ()) -> Drawn:
    """Set the lateral friction of `links`, or of the whole body; that of a contact is the product of both bodies'."""
    drawn = float(rng.uniform(*friction))
    sim.body(body).set_friction(drawn, links)
    return {"friction": drawn}


@acts_at("reset", "start", "interval")
def set_contact_stiffness(sim: Sim, rng: Rng, *, body: str, stiffness: Positive, links: Sequence[str] = ()) -> Drawn:
    """Set the stiffness of contacts with `links`, or with the whole body [N/m]; its logarithm is drawn uniformly.

    It applies to each contact point: a foot that carries 50 N on one point sinks 5 mm into ground of 1e4 N/m. A policy
    trained with soft and stiff contacts depends less on the physics engine.
    """
    drawn = float(np.exp(rng.uniform(*np.log(stiffness))))
    sim.body(body).set_contact_stiffness(drawn, links)
    return {"stiffness": drawn}


@acts_at("reset", "start", "interval", change=0.0)
def shift_gravity(sim: Sim, rng: Rng, *, change: Range) -> Drawn:
    """Add `change` [m/s^2] to the vertical gravity: -9.81 with (-0.5, 0.5) is -10.31 to -9.31."""
    drawn = float(rng.uniform(*change))
    sim.shift_gravity(drawn)
    return {"change": drawn}


@acts_at("reset", "start", "interval", factor=1.0)
def scale_joint_damping(sim: Sim, rng: Rng, *, body: str, factor: NotNegative, joints: Sequence[str] = ()) -> Drawn:
    """Scale the damping of `joints`, or of all, by one factor."""
    drawn = float(rng.uniform(*factor))
    sim.body(body).scale_joint_damping(drawn, joints)
    return {"factor": drawn}


@acts_at("reset", "start", "interval")
def set_joint_damping(sim: Sim, rng: Rng, *, body: str, damping: NotNegative, joints: Sequence[str] = ()) -> Drawn:
    """Set the damping of `joints`, or of all [N m s/rad or N s/m]: for models without damping that could be scaled."""
    drawn = float(rng.uniform(*damping))
    sim.body(body).set_joint_damping(drawn, joints)
    return {"damping": drawn}


@acts_at("reset", "start", "interval", factor=1.0)
def scale_motor_strength(sim: Sim, rng: Rng, *, body: str, factor: NotNegative, joints: Sequence[str] = ()) -> Drawn:
    """Scale the force that the motors of `joints`, or of all, give by one factor."""
    drawn = float(rng.uniform(*factor))
    sim.body(body).scale_motor_strength(drawn, joints)
    return {"factor": drawn}


@acts_at("reset", "start", "interval")
def motor_friction(sim: Sim, rng: Rng, *, body: str, coulomb_nm: NotNegative, joints: Sequence[str] = ()) -> Drawn:
    """Set the dry friction of `joints`, or of all [N m or N]; every joint draws its own.

    The viscous part is the joint's damping: `set_joint_damping` and `scale_joint_damping`.
    """
    drawn = _draw_per_joint(sim, rng, body, joints, coulomb_nm)
    sim.body(body).set_joint_friction(np.array(list(drawn.values())), joints)
    return drawn


@acts_at("reset", "start", "interval")
def backlash(sim: Sim, rng: Rng, *, body: str, backlash_rad: NotNegative, joints: Sequence[str] = ()) -> Drawn:
    """Set the play of `joints`, or of all [rad or m], from end to end; every joint draws its own.

    They need `set_motors(.., backlash_rad=0.01)` in `build`, with any play above 0.
    """
    drawn = _draw_per_joint(sim, rng, body, joints, backlash_rad)
    sim.body(body).set_backlash(np.array(list(drawn.values())), joints)
    return drawn


@acts_at("reset", "start", "interval")
def voltage(sim: Sim, rng: Rng, *, body: str, voltage_v: Positive, joints: Sequence[str] = ()) -> Drawn:
    """Set the supply of the motors of `joints`, or of all [V]: one battery feeds them."""
    drawn = float(rng.uniform(*voltage_v))
    sim.body(body).set_voltage(drawn, joints)
    return {"voltage_v": drawn}


@acts_at("reset", "start", "interval", factor=1.0)
def torque_constant(sim: Sim, rng: Rng, *, body: str, factor: Positive, joints: Sequence[str] = ()) -> Drawn:
    """Scale the torque constants of the motors of `joints`, or of all; every motor draws its own factor."""
    drawn = _draw_per_joint(sim, rng, body, joints, factor)
    sim.body(body).scale_torque_constant(np.array(list(drawn.values())), joints)
    return drawn


@acts_at("reset", "start", "interval", bias_rad=0.0)
def motor_bias(sim: Sim, rng: Rng, *, body: str, bias_rad: Range, joints: Sequence[str] = ()) -> Drawn:
    """Set what the encoders of `joints`, or of all, read at 0 [rad or m]; every joint draws its own."""
    drawn = _draw_per_joint(sim, rng, body, joints, bias_rad)
    sim.body(body).set_encoder_bias(np.array(list(drawn.values())), joints)
    return drawn


@acts_at("reset", "start", "interval")
def motor_delay(sim: Sim, rng: Rng, *, body: str, delay_s: NotNegative, joints: Sequence[str] = ()) -> Drawn:
    """Set the time from a command to the torque of the motors of `joints`, or of all [s], to whole physics steps.

    It may be up to twice that of `set_motors(.., delay_s=0.02)` in `build`.
    """
    drawn = float(rng.uniform(*delay_s))
    sim.body(body).set_motor_delay(drawn, joints)
    return {"delay_s": drawn}


def _draw_per_joint(sim: Sim, rng: Rng, body: str, joints: Sequence[str], values: Range) -> Drawn:
    """Return a number per joint, by its name."""
    changed = sim.body(body)
    names = [changed.joint_names[joint] for joint in changed.find_joints(joints)]
    return dict(zip(names, rng.uniform(*values, len(names)).tolist(), strict=True))


@acts_at("start", "interval")
def lock_joints(sim: Sim, rng: Rng, *, body: str, joints: Sequence[str]) -> Drawn:
    """Hold `joints` where they are until the end of the episode, whatever the motors do."""
    sim.body(body).lock_joints(joints)
    return {}


@acts_at("reset", "start", "interval")
def set_color(
    sim: Sim, rng: Rng, *, body: str, red: Fraction, green: Fraction, blue: Fraction, links: Sequence[str] = ()
) -> Drawn:
    """Paint `links`, or the whole body, in one colour; a texture stays visible."""
    drawn = [float(rng.uniform(*channel)) for channel in (red, green, blue)]
    sim.body(body).set_color(drawn, links)
    return dict(zip(("red", "green", "blue"), drawn, strict=True))


@acts_at("reset", "start", "interval")
def set_light(sim: Sim, rng: Rng, *, brightness: Positive, azimuth: Range, elevation: Elevation) -> Drawn:
    """Light the pictures of cameras from elsewhere, `brightness` times as bright as usual.

    The light is at `azimuth` [degrees], counterclockwise from the x axis, and `elevation` [degrees] above the ground.
    """
    drawn = {
        "brightness": float(rng.uniform(*brightness)),
        "azimuth": float(rng.uniform(*azimuth)),
        "elevation": float(rng.uniform(*elevation)),
    }
    height = math.sin(math.radians(drawn["elevation"]))
    x, y, _ = _horizontal(math.cos(math.radians(drawn["elevation"])), math.radians(drawn["azimuth"]))
    sim.set_light(drawn["brightness"], (-x, -y, -height))
    return drawn


@acts_at("reset", "start", "interval", shift=0.0, turn=0.0)
def move_camera(sim: Sim, rng: Rng, *, camera: str, shift: Range, turn: Range = (0.0, 0.0)) -> Drawn:
    """Move a camera from where the task has it: by `shift` [m] along each axis of its picture, by `turn` [degrees]
    about each. A camera that somebody has mounted by hand is a little elsewhere."""
    by_shift, by_turn = rng.uniform(*shift, 3), rng.uniform(*turn, 3)
    sim.move_camera(camera, by_shift.tolist(), np.radians(by_turn).tolist())
    axes = ("right", "up", "forward")
    drawn = {f"shift {axis}": float(value) for axis, value in zip(axes, by_shift, strict=True)}
    return drawn | {f"turn {axis}": float(value) for axis, value in zip(axes, by_turn, strict=True)}


@acts_at("reset", "start", "interval")
def set_distractors(
    sim: Sim, rng: Rng, *, count: Steps, center: Sequence[float], distance: NotNegative, size: Positive
) -> Drawn:
    """Show boxes, balls and cylinders in the pictures of cameras, in random colours; nothing touches them.

    They stand at the height of `center` [m], around it at a horizontal `distance` [m]; `size` [m] is half of each side.
    """
    drawn = int(rng.integers(int(count[0]), int(count[1]) + 1))
    shown = []
    for _ in range(drawn):
        x, y, _ = _horizontal(float(rng.uniform(*distance)), float(rng.uniform(-math.pi, math.pi)))
        shape: ShapeName = SHAPES[int(rng.integers(len(SHAPES)))]
        sides = rng.uniform(*size, 3)
        if shape != "box":
            sides[1:] = sides[0]
        place = (center[0] + x, center[1] + y, center[2] + float(sides[2]))
        yaw = float(rng.uniform(-math.pi, math.pi))
        shown.append(Distractor(shape, place, sides.tolist(), yaw, rng.uniform(0.0, 1.0, 3).tolist()))
    sim.set_distractors(shown)
    return {"count": float(drawn)}


OF_APPEARANCE = frozenset({set_color, set_light, move_camera, set_distractors})
"""Functions that change only what cameras see."""


@acts_at("start", position=0.0, velocity=0.0)
def offset_joints(
    sim: Sim,
    rng: Rng,
    *,
    body: str,
    position: Range = (0.0, 0.0),
    velocity: Range = (0.0, 0.0),
    joints: Sequence[str] = (),
) -> Drawn:
    """Add random offsets to the start state of `joints`, or all: position [rad or m] and velocity [rad/s or m/s].

    Every joint draws its own offsets; positions stay inside the joint's limits.
    """
    moved = sim.body(body)
    indices = moved.find_joints(joints)
    by_position = rng.uniform(*position, len(indices))
    by_velocity = rng.uniform(*velocity, len(indices))
    positions, velocities = moved.joint_positions.copy(), moved.joint_velocities.copy()
    low, high = moved.joint_low[indices], moved.joint_high[indices]
    started = positions[indices] + by_position
    # A joint has no limits if its lower limit is not below the upper one.
    positions[indices] = np.where(low < high, np.clip(started, low, high), started)
    velocities[indices] += by_velocity
    moved.set_joints(positions, velocities)
    names = [moved.joint_names[index] for index in indices]
    drawn = {f"{name} position": float(by) for name, by in zip(names, by_position, strict=True)}
    return drawn | {f"{name} velocity": float(by) for name, by in zip(names, by_velocity, strict=True)}


@acts_at("start", "interval", force=0.0)
def push(
    sim: Sim,
    rng: Rng,
    *,
    body: str,
    force: NotNegative,
    duration_s: Positive = (0.1, 0.1),
    link: str | None = None,
) -> Drawn:
    """Push a link, or the base, with a horizontal force [N] from a random side for `duration_s` [s].

    The duration is rounded to control steps, at least one.
    """
    drawn = {
        "force": float(rng.uniform(*force)),
        "direction": float(rng.uniform(-math.pi, math.pi)),  # [rad], from the world's x axis
        "duration_s": float(rng.uniform(*duration_s)),
    }
    sim.push(body, _horizontal(drawn["force"], drawn["direction"]), drawn["duration_s"], link)
    return drawn


@acts_at("start", "interval", speed=0.0)
def kick(sim: Sim, rng: Rng, *, body: str, speed: NotNegative) -> Drawn:
    """Add a horizontal `speed` [m/s] in a random direction to the velocity of the base."""
    kicked = sim.body(body)
    if kicked.fixed:
        raise TaskError(f"body {body!r} is fixed to the world: a kick cannot move it")
    drawn = {"speed": float(rng.uniform(*speed)), "direction": float(rng.uniform(-math.pi, math.pi))}
    kicked.add_velocity(_horizontal(drawn["speed"], drawn["direction"]))
    return drawn


def _horizontal(length: float, direction: float) -> tuple[float, float, float]:
    return length * math.cos(direction), length * math.sin(direction), 0.0


@acts_at("observation", "action", std=0.0)
def noise(rng: Rng, first: ObservationParts, *, std: NotNegative) -> tuple[Drawn, Signal]:
    """Add normal noise to every element at every step.

    Its standard deviation, in the unit of the observation or the action, is drawn once per episode.
    """
    return in_one_world(WorldNoise, rng, first, std=std)


@acts_at("observation", "action", steps=0.0)
def delay(rng: Rng, first: ObservationParts, *, steps: Steps) -> tuple[Drawn, Signal]:
    """Delay all values by some control steps; the number is drawn once per episode, both ends included.

    In these first steps the observation is the first of the episode, and the action is 0 or the nearest to 0.
    """
    return in_one_world(WorldDelay, rng, first, steps=steps)


WORLD_SIGNALS[noise] = WorldNoise
WORLD_SIGNALS[delay] = WorldDelay
