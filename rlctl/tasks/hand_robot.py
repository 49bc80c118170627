"""The arm of a starter plugin that picks, places or pushes a block: gripper, table, motors from a user's model."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.tasks.asked_motors import AskedMotors
from rlctl.tasks.finger_shapes import find_unfit, fit_boxes, replace_shapes
from rlctl.tasks.grippers import Gripper, GripperSearch
from rlctl.tasks.linkage import Linkage
from rlctl.tasks.loops import replace_loops, write_armature
from rlctl.tasks.model_copy import copy_model, find_own_model, remove_floor
from rlctl.tasks.motors import ChosenMotors, choose_motors
from rlctl.tasks.shapes import Array, Shapes
from rlctl.tasks.source_text import SourceText, join_source, write_comment, write_list, write_number, write_string
from rlctl.tasks.starter_robot import StarterRobot, check_mounted, list_faults, name_robot
from rlctl.tasks.surfaces import Surfaces
from rlctl.tasks.tabletop import TableArea, find_table

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody

TEMPLATE = Path(__file__).with_name("template_pick")
"""Templates of the files that differ from those of an arm that reaches."""
_CONTROL_DT, _SUBSTEPS = 0.04, 6
_DENSITY = 1000.0  # [kg/m^3], of the block
_LONGEST, _BIGGEST_MESH = 20.0, 5.0  # [m], of an arm; of the reach, of a link's shapes
_FASTEST = {False: 1.2, True: 0.25}  # [rad/s], and [m/s] of joints that slide
_REACH = 0.85  # [m], of the arm for which the reward's lengths were chosen
_IN_TABLE = 1e-3  # [m]
_CAMERA_AWAY, _CAMERA_HEIGHT, _CAMERA_TARGET = 0.8, 0.7, 0.1  # of the reach, from the middle of the area
_WRIST_BEHIND, _WRIST_ASIDE = 0.1, 0.08  # [m], from the tip, of an arm of that reach
_INCLINED = 0.1  # [rad]
_STEPS = {"pick": 4_000_000, "place": 4_000_000, "push": 5_000_000}


@dataclasses.dataclass(frozen=True)
class _Hand:
    kind: str
    path: Path
    linkage: Linkage
    gripper: Gripper
    table: TableArea
    motors: ChosenMotors
    position: Array  # [m], of the base, from where the file has it
    boxed: dict[str, int]  # number of boxes by link
    asked: AskedMotors | None  # of the arm

    @property
    def body(self) -> MujocoBody:
        return self.linkage.body

    @property
    def scale(self) -> float:
        """The arm's size."""
        return self.table.reach / _REACH

    @property
    def block(self) -> Array:
        """The block's sizes [m]."""
        return np.round([self.gripper.width, self.gripper.width, self.gripper.height], 4)

    @property
    def mass(self) -> float:
        return float(f"{_DENSITY * np.prod(self.block):.2g}")

    @property
    def tolerance(self) -> float:
        return float(f"{max(0.036 * self.scale, 0.4 * self.gripper.width):.2g}")


def read_hand_robot(
    model: str,
    kind: str,
    *,
    gripper: str | None = None,
    tip: str | None = None,
    asked: AskedMotors | None = None,
) -> StarterRobot:
    """Read a user's URDF or MJCF file of an arm with a gripper, for a task of a `kind`: pick, place or push.

    `gripper` is a joint of the gripper, `tip` a link whose origin is between the fingers, where these are to be found
    in the model by default. The arm has the real motors that are `asked` for, or springs. Raises `UsageError` for a
    file that is missing or cannot be loaded, and for an arm without a gripper, with one that never closes, or that does
    not reach the table.
    """
    path = find_own_model(model)
    files = copy_model(path)
    notes = remove_floor(files, Path(path.name))
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, path.name)
        _write(files, copy.parent)
        linkage = _load(copy, model)
        surfaces = _read_surfaces(copy, linkage)
        found = _find_gripper(linkage, surfaces, gripper, tip)
        looped = replace_loops(files, Path(path.name), linkage, found)
        if looped:
            notes += looped
            _write({Path(path.name): files[Path(path.name)]}, copy.parent)
            linkage = _load(copy, model)
        unfit = find_unfit(copy, linkage, found)
        boxes = fit_boxes(unfit, linkage, surfaces, found)
        if boxes:
            replace_shapes(files, Path(path.name), boxes)
            _write({Path(path.name): files[Path(path.name)]}, copy.parent)
            linkage = _load(copy, model)
        boxed = {link: len(fitted) for link, fitted in boxes.items()}
        hand = dataclasses.replace(_place(kind, path, linkage, found, boxed), asked=asked)
        if looped:
            names, armature = linkage.body.joint_names, hand.motors.armature
            write_armature(files, Path(path.name), {names[joint]: armature[joint] for joint in found.joints})
        files[Path("block.urdf")] = _write_block(hand)
        values, summary = _describe(hand), _summarize(hand, notes)
    kept = frozenset({kind, "drives" if asked is None else "motors"})
    return StarterRobot(values, files, summary, template=TEMPLATE, kept=kept)


def _write(files: dict[Path, bytes], folder: Path) -> None:
    for path, data in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)


def _load(path: Path, model: str) -> Linkage:
    from rlctl.task.mujoco.sim import MujocoSim

    sim = MujocoSim(control_dt=_CONTROL_DT, substeps=_SUBSTEPS)
    try:
        body = sim.load("arm", path, fixed=True)
    except TaskError as error:
        raise UsageError(f"--model: {str(error).replace(str(path), model)}") from None
    check_mounted(body, model, "--pick, --place and --push are for an arm that is mounted")
    return Linkage(body)


def _read_surfaces(path: Path, linkage: Linkage) -> Surfaces:
    """Return the surfaces of links; raises `UsageError` for a model in millimetres."""
    surfaces, file = Surfaces(path), path.name
    positions = np.array([np.clip(0.0, *linkage.find_ends(joint)) for joint in range(linkage.count)])
    linkage.place(positions)
    anchors = np.array([linkage.axis(joint)[0] for joint in range(linkage.count)])
    length = float(np.linalg.norm(np.ptp(anchors, axis=0)))
    if length > _LONGEST:
        raise UsageError(
            f"--model: {file}: its joints are {length:.0f} m apart, so its unit may be millimetres; divide its lengths "
            "by 1000"
        )
    for link in linkage.body.parts.links:
        points = surfaces.list_points(link)
        size = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
        if length > 0 and size > max(_BIGGEST_MESH * length, 1.0):
            raise UsageError(
                f"--model: {file}: link {link!r} is {size:.0f} m long, of an arm of {length:.2g} m, so the unit of its "
                'meshes may be millimetres; give them scale="0.001 0.001 0.001"'
            )
    return surfaces


def _find_gripper(linkage: Linkage, surfaces: Surfaces, joint: str | None, tip: str | None) -> Gripper:
    body = linkage.body
    if joint is not None:
        check_name(joint, body.joint_names, f"--gripper: {body.file.name} has no joint", UsageError)
    if tip is not None:
        check_name(tip, body.link_names, f"--tip: {body.file.name} has no link", UsageError)
    gripper = GripperSearch(linkage, surfaces).find(joint)
    if tip is None:
        return gripper
    palm_links = linkage.list_links(gripper.arm[-1])
    if tip not in palm_links:
        raise UsageError(f"--tip {tip!r}: it does not move with the palm; choose one of: {', '.join(palm_links)}")
    linkage.place(gripper.open)
    turn, origin = linkage.frame(gripper.palm)
    return dataclasses.replace(gripper, point=(linkage.frame(tip)[1] - origin) @ turn)


def _place(kind: str, path: Path, linkage: Linkage, gripper: Gripper, boxed: dict[str, int]) -> _Hand:
    """Put the arm onto the table, and choose where the block is."""
    linkage.place(gripper.open)
    body = linkage.body
    fixed = {body.find_link(link) for link in linkage.list_links(-1)}
    geoms = [geom for geom in body.parts.geoms if int(linkage.model.geom_bodyid[geom]) in fixed]
    lowest = Shapes(linkage.model, geoms).find_lowest(linkage.data)
    base = linkage.frame(body.base_name)[1]
    lowest = min(lowest, float(base[2])) if math.isinf(lowest) else lowest
    raised = math.ceil(1e3 * -lowest) / 1e3 if lowest < -_IN_TABLE else 0.0
    table, height = find_table(linkage, gripper, raised, lowest)
    motors = choose_motors(linkage, gripper, table.start, _block_mass(gripper))
    position = np.array([0.0, 0.0, height])
    return _Hand(kind, path, linkage, gripper, table, motors, position, boxed, None)


def _block_mass(gripper: Gripper) -> float:
    return _DENSITY * gripper.width**2 * gripper.height


def _write_block(hand: _Hand) -> bytes:
    sizes, mass = hand.block, hand.mass
    squares = sizes**2
    moments = mass / 12 * (squares.sum() - squares)
    inertia = " ".join(f'i{axis}{axis}="{moment:.3g}"' for axis, moment in zip("xyz", moments.tolist(), strict=True))
    box = f'<geometry><box size="{" ".join(f"{size:g}" for size in sizes)}"/></geometry>'
    return f"""<?xml version="1.0"?>
<robot name="block">
  <material name="orange"><color rgba="0.95 0.42 0.05 1"/></material>
  <link name="block">
    <contact><lateral_friction value="1.0"/></contact>
    <inertial><mass value="{mass:g}"/><inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial>
    <visual>{box}<material name="orange"/></visual>
    <collision>{box}</collision>
  </link>
</robot>
""".encode()


def _summarize(hand: _Hand, notes: Sequence[str]) -> str:
    """Return what was found, a sentence a line."""
    names, gripper, table = hand.body.joint_names, hand.gripper, hand.table
    area = table.high - table.low
    shaped = [[link for link in links if _has_shapes(hand.linkage, link)] for links in gripper.fingers]
    fingers = " and ".join(repr(links[-1]) for links in shaped)
    fixed = ", which does not move," if gripper.has_fixed_finger else ""
    driver = gripper.drivers[0]
    lines = [
        f"{hand.path.name}: {', '.join(names[joint] for joint in gripper.arm)} carry a gripper that opens "
        f"{1e3 * gripper.opening:.0f} mm",
        f"Its fingers {fingers}{fixed} close while {names[driver]} goes from {gripper.open[driver]:.3g} to "
        f"{gripper.closed[driver]:.3g}; they hold at {_write_vector(gripper.point)} m of {gripper.palm!r}",
        f"The block is {1e3 * hand.block[0]:.0f} x {1e3 * hand.block[1]:.0f} x {1e3 * hand.block[2]:.0f} mm and "
        f"{1e3 * hand.mass:.0f} g, on {100 * area[0]:.0f} x {100 * area[1]:.0f} cm of the table around "
        f"{_write_vector((table.low + table.high) / 2)} m",
    ]
    if hand.boxed:
        boxes = ", ".join(f"{link} ({count})" for link, count in hand.boxed.items())
        lines.append(
            f"Collision shapes of {boxes} cannot hold a block, or are missing: the copy has boxes around slices of the "
            "link instead. Look at them with the first command below"
        )
    if table.tilt > _INCLINED:
        lines.append(f"It reaches the table with its fingers {math.degrees(table.tilt):.0f} degrees from straight down")
    if hand.position[2]:
        lines.append(f"Its base is {hand.position[2]:+.3g} m higher than in the file, so that it is on the table")
    if gripper.others:
        lines.append(
            f"Other grippers keep START; for one of them: {', '.join(f'--gripper {name}' for name in gripper.others)}"
        )
    lines += [*notes, *hand.motors.notes, *list_faults(hand.body)]
    lines.append(
        "--gripper and --tip choose another joint and point; comments with CHANGE in task.py mark what to adapt"
    )
    return ".\n".join(lines)


def _write_vector(values: Array) -> str:
    return ", ".join(f"{value + 0.0:.3g}" for value in np.round(values, 4).tolist())


def _write_array(values: Sequence[float] | Array, form: str = "") -> SourceText:
    return SourceText(f"[{join_source(write_number(value, form) for value in np.asarray(values) + 0.0)}]")


def _describe(hand: _Hand) -> dict[str, str]:
    body, gripper, table, motors = hand.body, hand.gripper, hand.table, hand.motors
    names, driven = body.joint_names, gripper.driven
    fingers = sorted({link for links in gripper.fingers for link in links if _has_shapes(hand.linkage, link)})
    speeds = [_limit_speed(hand, joint) for joint in gripper.arm]
    holding = gripper.open[driven[0]] - gripper.closed[driven[0]]
    share = (gripper.holding[driven[0]] - gripper.closed[driven[0]]) / holding
    scale, name = hand.scale, name_robot(hand.path)
    area = [np.round(corner + hand.position[:2], 3) for corner in (table.low, table.high)]
    goals = np.round([table.goal_low, table.goal_high], 3)
    held = 1.2 * max(gripper.width, gripper.height / 2)
    return {
        "robot": name,
        "robot_phrase": name,
        "model": hand.path.name,
        "arm": write_list("ARM = ", [write_string(names[joint]) for joint in gripper.arm]),
        "gripper": write_list("GRIPPER = ", [write_string(names[joint]) for joint in driven]),
        "open": _write_array(gripper.open[driven]),
        "closed": _write_array(gripper.closed[driven]),
        "fingers": write_list("FINGERS = ", map(write_string, fingers)),
        "palm": gripper.palm,
        "tip_point": _write_array(gripper.point),
        "tip_down": _write_array(gripper.frame[:, 2]),
        "tip_side": _write_array(gripper.frame[:, 0]),
        "all_joints": write_comment(f"Of all joints of the model: {', '.join(names)}."),
        "start": write_list("START = np.array(", map(write_number, table.start + 0.0), ")"),
        "stiffness": write_list("STIFFNESS = ", [write_number(value, ".3g") for value in motors.stiffness]),
        "damping": write_list("DAMPING = ", [write_number(value, ".3g") for value in motors.damping]),
        "armature": write_list("ARMATURE = ", [write_number(value, ".3g") for value in motors.armature]),
        "max_force": write_list("MAX_FORCE = ", [write_number(value, ".3g") for value in motors.max_force]),
        "max_speed": write_list("MAX_SPEED = ", map(write_number, speeds)),
        "inclined": SourceText(
            f" {math.degrees(table.tilt):.0f} degrees inclined" if table.tilt > _INCLINED else " down"
        ),
        "area_low": _write_array(area[0]),
        "area_high": _write_array(area[1]),
        "half": write_number(hand.block[2] / 2, ".4g"),
        "width": write_number(hand.block[0], ".3g"),
        "goal_heights": SourceText(f"({join_source(write_number(goal, 'g') for goal in goals)})"),
        "held": write_number(held, ".2g"),
        "scale": write_number(0.2 * scale, ".2g"),
        "lifted": write_number(0.08 * scale, ".2g"),
        "tolerance": write_number(hand.tolerance, "g"),
        "smaller": write_number(hand.tolerance / 2, "g"),
        "nearest": write_number(max(2 * hand.tolerance, 0.12 * table.reach), ".2g"),
        "noise": write_number(0.1 * hand.tolerance, ".1g"),
        "fixed": _write_position(hand),
        "released": write_number(min(0.9, share + 0.15), ".2g"),
        "total_timesteps": f"{_STEPS[hand.kind]:_}",
        "sag": write_number(0.05 * table.reach, ".2g"),
        "least_down": write_number(-math.cos(table.tilt + 0.35), ".2g"),
        **_describe_held(hand),
        **_describe_cameras(hand),
        **_describe_motors(hand),
    }


def _describe_cameras(hand: _Hand) -> dict[str, str]:
    """Return where cameras are: before the table, looking back at the arm, and on the palm, looking at the tip."""
    table, gripper = hand.table, hand.gripper
    middle = (table.low + table.high) / 2 + hand.position[:2]
    eye = middle + _CAMERA_AWAY * table.reach * table.outwards
    aside = np.cross(gripper.frame[:, 2], gripper.frame[:, 0])
    wrist = gripper.point - _WRIST_BEHIND * hand.scale * gripper.frame[:, 2] + _WRIST_ASIDE * hand.scale * aside
    return {
        "camera_eye": _write_point([*eye, _CAMERA_HEIGHT * table.reach]),
        "camera_target": _write_point([*middle, _CAMERA_TARGET * table.reach]),
        "wrist_eye": _write_point(wrist),
        "wrist_up": _write_point(-aside),
        "tip_tuple": _write_point(gripper.point),
    }


def _write_point(values: Sequence[float] | Array) -> SourceText:
    numbers = np.round(values, 3) + 0.0
    return SourceText(f"({join_source(write_number(value, 'g') for value in numbers)})")


def _describe_motors(hand: _Hand) -> dict[str, str]:
    """Return texts of the real motors that were asked for; values that their table does not have are of springs."""
    if hand.asked is None:
        return {}
    chosen = hand.gripper.arm
    guesses = {
        "stiffness_nm_per_rad": hand.motors.stiffness,
        "damping_nms_per_rad": hand.motors.damping,
        "armature_kgm2": hand.motors.armature,
    }
    medians = {name: float(f"{np.median(values[chosen]):.2g}") for name, values in guesses.items()}
    return hand.asked.write(medians, "arm", joints="ARM")


def _describe_held(hand: _Hand) -> dict[str, str]:
    """Return how a block is put between the fingers: from the tip, and how it is turned in the palm's frame."""
    import mujoco

    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(hand.gripper.frame).ravel())
    offset = hand.gripper.held_point - hand.gripper.point
    return {
        "towards_held": SourceText(f"+ rotate(hand, {_write_array(offset)})"),
        "block_turn": _write_array(quaternion[[1, 2, 3, 0]]),
    }


def _has_shapes(linkage: Linkage, link: str) -> bool:
    number = linkage.body.find_link(link)
    return any(int(linkage.model.geom_bodyid[geom]) == number for geom in linkage.body.parts.geoms)


def _limit_speed(hand: _Hand, joint: int) -> float:
    fastest, limit = _FASTEST[hand.linkage.slides(joint)], float(hand.body.joint_max_speed[joint])
    return min(fastest, limit) if limit > 0 else fastest


def _write_position(hand: _Hand) -> SourceText:
    """Return the arguments of `Sim.load` that say where the base is; only URDF files do not contain it."""
    position = f", position={tuple(round(value, 3) for value in hand.position.tolist())}" if hand.position.any() else ""
    fixed = ", fixed=True" if hand.path.suffix == ".urdf" else ""
    return SourceText(position + fixed)
