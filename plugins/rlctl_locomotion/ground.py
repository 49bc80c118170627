"""The ground that legged robots walk on: a plane, or rough ground from a seed."""

from __future__ import annotations

from rlctl.task import Body, Sim, TaskError, rough_heights

LENGTH = 48.0  # [m], along x: further than any of them gets in an episode
CELL = 0.12  # [m]


def add_ground(sim: Sim, *, roughness: float, seed: int, highest_step: float, width: float) -> Body:
    """Load the ground as body `ground`: flat, or with steps of up to `roughness` [m] but at the start.

    Raises `TaskError` for steps above `highest_step` [m], which a leg cannot get over, or which bury the robot.
    """
    if roughness > highest_step:
        raise TaskError(
            f"roughness: steps of {roughness:g} m would bury this robot's legs. Use at most {highest_step:g} m."
        )
    if roughness == 0:
        ground = sim.load("ground", "plane.urdf", fixed=True)
    else:
        heights = rough_heights(seed, size=(LENGTH, width), cell=CELL, roughness=roughness, flat_radius=0.6)
        ground = sim.add_height_field("ground", heights, cell=CELL)
    ground.set_friction(1.0)
    return ground
