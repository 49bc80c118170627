"""Which expressions of a source are places in the world, by their names and by the engine that returns them."""

import ast
import re

from rlctl.checking.assignments import list_parameters, list_words
from rlctl.checking.source_code import Expression

PLACE_WORDS = {
    *("pos", "position", "positions", "place", "xpos", "goal", "goals", "target", "targets", "waypoint", "waypoints"),
    *("xy", "xyz", "site", "point", "origin", "base", "ball", "box", "cube", "object", "puck", "gate", "dock"),
    *("station", "drone", "robot", "com", "center", "centre", "beacon", "door", "hand", "tip", "handle", "qpos", "fix"),
}
AXES = {"x", "y", "z", "px", "py", "pz"}
JOINT_WORDS = {"joint", "joints", "leg", "legs", "finger", "fingers", "wheel", "wheels", "motor", "motors", "dof"}
FREE_PLACE = r"qpos\[0?:3\](\.copy\(\)|\.astype\([^)]*\)|\))*$"
ENGINE_PLACE = (
    r"(\.(site_|geom_)?xi?pos(\[[^:]*\])?|getBasePositionAndOrientation\(.*\)\[0\]|getLinkState\(.*\)\[[024]\]"
    r"|base_position|link_position\(.*\)|get_(body_com|site_xpos)\(.*\))(\[(:,)?0?:[23]\]|\.copy\(\)|\))*$"
)
"""Places in the world that MuJoCo, PyBullet and tasks of rlctl return."""


def is_place(one: Expression) -> bool:
    """Say whether an expression is called a place, and not the angles of joints."""
    words = list_words(one.node)
    parameters = set(list_parameters(one.function))
    if any(isinstance(node, ast.Name) and node.id in parameters for node in ast.walk(one.node)):
        return False  # of a function that may be called with anything
    if not isinstance(one.node, ast.Name | ast.Attribute | ast.Subscript) or words & JOINT_WORDS:
        return False
    return bool(words & (PLACE_WORDS - {"qpos"})) or bool(re.search(r"qpos\[0?:[23]\]", one.text.replace(" ", "")))


def is_of_engine(one: Expression) -> bool:
    """Say whether an engine returns a place."""
    return bool(re.search(ENGINE_PLACE, one.text.replace(" ", "")))
