"""RL840: two motors of one joint."""

import collections
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.experiments.build import judges_built
from rlctl.checking.instance import Instance
from rlctl.checking.mujoco_worlds import SLIDE
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.environments.simulations import find_mujoco

RULE = Rule(
    "RL840",
    "two motors of one joint",
    Severity.WARNING,
    meaning="""
        In a MuJoCo model two actuators of the same kind drive one joint, and another joint has none, most often since a
        name was copied and not changed. Two elements of the action then add up at one joint, and the other hangs
        loose. Actuators of different kinds on one joint, such as position and velocity, belong together, and so do two
        of which each pushes in one direction.
    """,
    fix="Name each joint once in the actuators of the model.",
)


@judges_built(RULE)
def _find_doubled_joints(instance: Instance) -> Iterator[RuleFinding]:
    simulation = find_mujoco(instance.env)
    if simulation is None:
        return
    from mujoco import mjtDyn, mjtTrn

    model, _ = simulation
    drives = collections.defaultdict[tuple[int, ...], list[int]](list)
    for actuator in range(model.nu):
        if mjtTrn(model.actuator_trntype[actuator]) in (mjtTrn.mjTRN_JOINT, mjtTrn.mjTRN_JOINTINPARENT):
            kinds = (model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype)
            key = (int(model.actuator_trnid[actuator, 0]), *(int(kind[actuator]) for kind in kinds))
            drives[key].append(actuator)
    driven = {joint for joint, *_ in drives}
    free = [joint for joint in range(model.njnt) if joint not in driven and model.jnt_type[joint] >= SLIDE]
    for (joint, *_), actuators in drives.items():
        is_muscle = mjtDyn(model.actuator_dyntype[actuators[0]]) == mjtDyn.mjDYN_MUSCLE
        if len(actuators) == 2 and free and not is_muscle and not _are_against_each_other(model, actuators):
            names = [model.actuator(one).name or f"actuator {one}" for one in actuators]
            without = [model.joint(one).name or f"joint {one}" for one in free]
            message = f"{names[0]} and {names[1]} both drive {model.joint(joint).name or f'joint {joint}'}, and nothing"
            message += f" drives {list_names(without, 4)}"
            yield RuleFinding(RULE, message, {"element": names[1], "value": model.joint(joint).name})


def _are_against_each_other(model: Any, actuators: Sequence[int]) -> bool:
    """Say whether each pulls in one direction only, and the other one back: thrusters, cables, or pneumatic pairs."""
    one, other = np.sign(model.actuator_gear[actuators, 0] * np.sum(model.actuator_ctrlrange[actuators], axis=1))
    is_one_way = model.actuator_ctrlrange[actuators].prod(axis=1) == 0  # 0 is one end
    return bool(model.actuator_ctrllimited[actuators].all() and is_one_way.all() and one * other < 0)
