"""How many swaps of two joints with different default positions `rlctl diagnose` names: all pairs of two robots."""

from __future__ import annotations

import dataclasses
import itertools
import os
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from rlctl_robot.diagnose.diagnose import Doctor, MappingFinding
from rlctl_robot.diagnose.signals import LoggedSignals
from tests.benchmarks.broken_logs import Robot, Wrong
from tests.benchmarks.diagnosing import is_named
from tests.benchmarks.row import Row

SECONDS = float(os.environ.get("SWAP_SECONDS", "30"))
STRIDE = int(os.environ.get("SWAP_STRIDE", "1"))  # of the pairs, one in so many
NAMED = 0.95  # of the pairs
IS_DIFFERENCE = {"walk": True, "reach": False}  # whether the policy observes and commands angles from the stance


def make_swap(robot: Robot, term: str, one: int, other: int) -> Wrong:
    """Return what the policy sees, or the robot does, when a program exchanges two of its own angles."""
    joints = robot.info.env.joints
    pose = np.array(joints.default_positions)
    order = list(range(len(pose)))
    order[one], order[other] = other, one
    offset: tuple[float, ...] = ()
    if IS_DIFFERENCE[robot.task]:
        scale: Any = np.array(joints.action_scale) if term == "actions" else 1.0
        offset = tuple(((pose[order] - pose) / scale).tolist())
    return Wrong(term, "swap of angles", order=tuple(order), offset=offset)


def is_named_of_joints(wrongs: Sequence[Wrong], finding: MappingFinding, size: int) -> bool:
    """Whether a finding says exactly that a driver exchanges all quantities of two joints."""
    parts = () if finding.correction is None else finding.correction.parts
    findings = [dataclasses.replace(finding, correction=part) for part in parts]
    return len(parts) == len(wrongs) and all(any(is_named(wrong, one, size) for one in findings) for wrong in wrongs)


def make_swaps(robot: Robot, one: int, other: int) -> list[list[Wrong]]:
    """Return the swaps of two joints: of measured angles, of targets, and of all quantities of the joints."""
    positions, actions = (make_swap(robot, term, one, other) for term in ("joint_positions", "actions"))
    velocities = Wrong("joint_velocities", "swap", order=positions.order)
    return [[positions], [actions], [positions, velocities, actions]]


def count_named(task: str) -> tuple[int, int]:
    """Return how many swaps are named first, and how many there are."""
    robot = Robot(task)
    doctor = Doctor(robot.policy_file, robot.spec)
    pose = robot.info.env.joints.default_positions
    pairs = [pair for pair in itertools.combinations(range(len(pose)), 2) if pose[pair[0]] != pose[pair[1]]]
    named = total = 0
    for number, (one, other) in list(enumerate(pairs))[::STRIDE]:
        for wrongs in make_swaps(robot, one, other):
            log = robot.log(wrongs, SECONDS, 40_000 + number, randomized=bool(number % 2))
            found = doctor.diagnose(LoggedSignals(log.observations, log.actions, log.lengths, log.sizes))[0]
            check = is_named_of_joints if len(wrongs) > 1 else _is_named
            right = bool(found) and check(wrongs, found[0], len(pose))
            named += right
            total += 1
            terms = " and ".join(wrong.term for wrong in wrongs)
            texts = " | ".join(f"{finding.evidence:.0f} {finding.text}" for finding in found)
            if not right or os.environ.get("VERBOSE"):
                result = "named" if right else "MISSED"
                print(f"{result} {terms} {one} {other}: {texts or 'nothing'}", file=sys.stderr, flush=True)
    return named, total


def _is_named(wrongs: Sequence[Wrong], finding: MappingFinding, size: int) -> bool:
    return is_named(wrongs[0], finding, size)


def _row(task: str, repeat: int) -> Row:
    named, total = count_named(task)
    return Row(
        f"diagnose swaps {task}",
        f"{named} of {total} named",
        "",
        "",
        f">= {NAMED:.0%}",
        named >= NAMED * total,
        "all pairs of joints with different default positions, of measured angles, of targets and of all quantities "
        "of the joints, in the closed loop",
    )


reach = partial(_row, "reach")
walk = partial(_row, "walk")
