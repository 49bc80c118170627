"""RL843: part falls through the floor."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.mujoco_worlds import MujocoStateReader
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity, list_others
from rlctl.checking.world_logs import WorldLog
from rlctl.checking.worlds import Link
from rlctl.environments.bullet_clients import ClientCalls
from rlctl.task.rotations import rotate

RULE = Rule(
    "RL843",
    "part falls through the floor",
    Severity.WARNING,
    meaning="""
        A link of a robot with a free base never touches anything, and at the end of nearly all episodes its centre of
        mass is below the floor: it has no shape for collisions, or its shape is left out of them. Wheels, feet or the
        whole robot pass through the ground, and what they should drive does not move.
    """,
    fix="""
        Give the link a collision shape: <collision> in a URDF, linkCollisionShapeIndices of createMultiBody, and in
        MuJoCo a contype and a conaffinity that are not 0.
    """,
)

PLANE, BOX = 0, 6  # MuJoCo's types of geoms
LEVEL = 1e-6  # of elements of a quaternion
WIDE = 2.0  # of a body that is the ground [m]
BELOW = 0.005  # of a centre of mass below the floor [m]
OFTEN, NEARLY_ALL = 0.2, 0.8  # parts of the looks, and of the episodes
FEWEST_LOOKS, FEWEST = 4, 3  # of an episode; episodes
CENTRE = slice(7, 10)  # of a pose
UP = (0.0, 0.0, 1.0)


@judges_worlds(RULE)
def _find_fallen_parts(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        try:
            floor = _find_floor(one)
        except one.world.reader.errors as error:
            raise NotJudged("the world is gone") from error
        found = [] if floor is None else _list_below(one, floor)
        if floor is not None and found:
            names = [one.world.world.link_name(link) for link in found]
            heights = [log.poses[-1][found[0]][CENTRE][2] for log in _list_long(one) if found[0] in log.poses[-1]]
            message = (
                f"the centre of mass of {names[0]} is {floor - float(np.median(heights)):.2g} m below the floor at"
            )
            message += f" the end of an episode{list_others(names)}, and nothing ever touches it"
            yield RuleFinding(RULE, message, {"element": names[0], "links": names, "value": float(np.median(heights))})
            return


def _list_long(one: ObservedWorld) -> list[WorldLog]:
    return [log for log in one.logs if len(log.poses) >= FEWEST_LOOKS and log.actions != "extreme"]


def _list_below(one: ObservedWorld, floor: float) -> list[Link]:
    """Return the links of free robots that are below the floor at the ends of episodes, and never touch anything."""
    robots = {body.id for body in one.world.world.bodies if body.is_free and body.joints}
    touched = {link for log in one.logs for pairs in log.touching for pair in pairs for link in pair}
    logs = _list_long(one)
    links = {link for log in logs for link in log.poses[0] if link[0] in robots and link not in touched}
    found: list[Link] = []
    for link in sorted(links):
        below = [[poses[link][CENTRE][2] < floor - BELOW for poses in log.poses if link in poses] for log in logs]
        looks = [look for each in below for look in each]
        ends = [each[-1] for each in below if each]
        if len(ends) >= FEWEST and np.mean(ends) >= NEARLY_ALL and np.mean(looks) >= OFTEN:
            found.append(link)
    return found


def _find_floor(one: ObservedWorld) -> float | None:
    """Return how high the ground is [m]; None where there is no level one."""
    reader = one.world.reader
    if isinstance(reader, MujocoStateReader):
        return _find_floor_in_mujoco(reader.model)
    p, heights = ClientCalls(one.world.world.client), list[float]()
    for body in one.world.world.bodies:
        low, high = p.getAABB(body.id)
        place, orientation = p.getBasePositionAndOrientation(body.id)
        is_ground = not body.is_free and not body.joints and min(high[0] - low[0], high[1] - low[1]) > WIDE
        if is_ground and rotate(orientation, UP)[2] > 1 - 1e-9:
            heights.append(float(high[2] if abs(high[2]) < WIDE else place[2]))
    return min(heights, default=None)


def _find_floor_in_mujoco(model: Any) -> float | None:
    is_solid = (model.geom_contype | model.geom_conaffinity).astype(bool)
    is_solid[np.concatenate([model.pair_geom1, model.pair_geom2])] = True  # some models list pairs instead
    is_solid |= (model.geom_type == PLANE) & ~is_solid[model.geom_type == PLANE].any()  # where nothing can touch it
    of_world = (model.body_weldid == 0)[model.geom_bodyid]
    turns = np.abs(model.geom_quat[:, 1:3]) + np.abs(model.body_quat[model.geom_bodyid][:, 1:3])
    is_wide = (model.geom_type == BOX) & (2 * model.geom_size[:, :2] > WIDE).all(axis=1)
    ground = np.flatnonzero(((model.geom_type == PLANE) | is_wide) & is_solid & of_world & (turns.max(axis=1) < LEVEL))
    tops = model.geom_pos[:, 2] + model.body_pos[model.geom_bodyid, 2] + is_wide * model.geom_size[:, 2]
    return float(tops[ground].min()) if len(ground) else None
