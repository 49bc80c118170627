"""How well `rlctl identify ROBOT` finds the values of servos: simulated robots with drawn values, a log each."""

from __future__ import annotations

import dataclasses
import os
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from rlctl.task.model_files import MODELS
from rlctl_robot.identify.motion import ServoLog, read_motion, write_motion
from rlctl_robot.identify.robot import RobotIdentification, identify_robot, play_through
from rlctl_robot.identify.robot_excite import draw_targets
from rlctl_robot.identify.robot_model import (
    ARMATURE,
    BIAS,
    COULOMB,
    DELAY,
    STIFFNESS,
    VISCOUS,
    RobotModel,
    Values,
    read_robot,
    stack_values,
)
from rlctl_robot.identify.windows import WindowPlayer
from tests.benchmarks.row import Row

LOGS = int(os.environ.get("IDENTIFY_LOGS", "20"))
FIRST = int(os.environ.get("IDENTIFY_FIRST", "0"))
SECONDS = float(os.environ.get("IDENTIFY_SECONDS", "60"))
TRUE_STEP_S = float(os.environ.get("IDENTIFY_TRUE_STEP", "0"))  # of the simulated robot; 0: that of its file
CONTROL_DT = 0.02
ENCODER = 2 * np.pi / 4096  # [rad], 12 bits
NOISE = 0.3 * ENCODER  # before the encoder rounds
BIAS_RANGE = 0.06  # [rad]
LONGEST_DELAY = 0.04  # [s]
MEDIAN, INSIDE, MINUTES, RATIO, GOOD = 0.05, 0.9, 3.0, 1.2, 0.9

ROBOTS = {"arm": Path(__file__).with_name("arm6.xml"), "quadruped": MODELS / "a1.urdf"}
RANGES = {
    "arm": {STIFFNESS: (8, 25), ARMATURE: (0.005, 0.03), VISCOUS: (0.2, 0.9), COULOMB: (0.03, 0.15)},
    "quadruped": {STIFFNESS: (30, 80), ARMATURE: (0.005, 0.03), VISCOUS: (0.5, 3.0), COULOMB: (0.1, 0.8)},
}


@dataclasses.dataclass(frozen=True)
class Trial:
    """How well the values of one robot were found."""

    errors: list[float]  # of known values, relative; of biases relative to the range that they are drawn from
    inside: list[bool]  # whether their intervals contain the true values
    unknown: int
    seconds: float
    busy: float  # [s], of all cores together: half of it is the time of two free cores
    ratio: float  # of the held-out error, to that of the true values


def draw_values(kind: str, robot: RobotModel, rng: np.random.Generator) -> Values:
    """Return servos' values of a robot that nobody has seen."""
    values = {name: np.array(value, np.float64) for name, value in robot.nominal.items()}
    for name, (low, high) in RANGES[kind].items():
        values[name] = rng.uniform(low, high, len(robot.joints))
    values[BIAS] = rng.uniform(-BIAS_RANGE, BIAS_RANGE, len(robot.joints))
    values[DELAY] = np.array(rng.uniform(0, LONGEST_DELAY))
    return values


def record(kind: str, seed: int, path: Path) -> tuple[RobotModel, Values]:
    """Write the log of a robot with drawn values."""
    rng = np.random.default_rng(seed)
    robot = read_robot(ROBOTS[kind])
    if TRUE_STEP_S:
        robot.model.opt.timestep = TRUE_STEP_S
    values = draw_values(kind, robot, rng)
    targets = draw_targets(robot, SECONDS, CONTROL_DT, 0.7, seed)
    stacked = stack_values(values, 1)
    still = np.zeros((1, len(robot.joints)))
    settle = WindowPlayer(robot, targets[:1], CONTROL_DT, 1)
    rest = settle.play(stacked, np.array([0]), targets[:1], still, 100)[:, -1]
    played = WindowPlayer(robot, targets, CONTROL_DT, 1).play(stacked, np.array([0]), rest, still, len(targets) - 1)
    noisy = played[0] + NOISE * rng.normal(size=played[0].shape)
    write_motion(path, robot.joints, targets, np.round(noisy / ENCODER) * ENCODER, CONTROL_DT)
    return read_robot(ROBOTS[kind]), values


def run_trial(kind: str, seed: int) -> Trial:
    """Record and identify one robot."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.csv"
        robot, true = record(kind, seed, log)
        began, used = time.monotonic(), time.process_time()
        verbose = (lambda line: print(line, flush=True)) if os.environ.get("VERBOSE") else (lambda _: None)
        found = identify_robot(str(ROBOTS[kind]), log, report=verbose)
        seconds, busy = time.monotonic() - began, time.process_time() - used
        motion = read_motion(log, robot.joints)
    return _judge(found, robot, true, motion, seconds, busy)


def _judge(
    found: RobotIdentification, robot: RobotModel, true: Values, motion: ServoLog, seconds: float, busy: float
) -> Trial:
    errors, inside, unknown = [], [], 0
    for value in found.values:
        joint = robot.joints.index(value.part) if value.part else 0
        right = float(np.ravel(true[value.quantity])[joint])
        reference = BIAS_RANGE if value.quantity == BIAS else max(abs(right), 1e-9)
        if value.quantity == DELAY:
            reference = LONGEST_DELAY
        if value.known:
            errors.append(abs(value.value - right) / reference)
            inside.append(value.low <= right <= value.high)
        else:
            unknown += 1
        if os.environ.get("VERBOSE"):
            print(
                f"{value.name:40s} {right:9.4g} {value.value:9.4g} [{value.low:.4g}, {value.high:.4g}] "
                f"{'' if value.low <= right <= value.high else 'OUTSIDE'} {value.note}",
                flush=True,
            )
    player = WindowPlayer(robot, motion.commands, motion.control_dt, 1)
    size = np.sqrt(np.square(play_through(player, motion, [true])[0][found.is_held_out]).mean())
    return Trial(errors, inside, unknown, seconds, busy, found.error_after / float(size))


def _row(kind: str, repeat: int) -> Row:
    trials = []
    for seed in range(FIRST, FIRST + LOGS):
        trial = run_trial(kind, seed)
        trials.append(trial)
        print(
            f"{kind} {seed}: median {np.median(trial.errors):.2%}, inside {np.mean(trial.inside):.0%}, known "
            f"{len(trial.errors)}, unknown {trial.unknown}, {trial.seconds:.0f} s ({trial.busy:.0f} s of cores), "
            f"held out x {trial.ratio:.3f}",
            file=sys.stderr,
            flush=True,
        )
    median = float(np.median([error for trial in trials for error in trial.errors]))
    inside = float(np.mean([one for trial in trials for one in trial.inside]))
    slowest = max(trial.seconds for trial in trials)
    good = sum(trial.ratio <= RATIO for trial in trials)
    unknown = sum(trial.unknown for trial in trials)
    count = sum(len(trial.errors) for trial in trials) + unknown
    reached = median <= MEDIAN and inside >= INSIDE and slowest <= 60 * MINUTES and good >= GOOD * len(trials)
    return Row(
        f"identify {kind}",
        f"median error {median:.1%}, {inside:.0%} inside, {slowest:.0f} s, held out <= x {RATIO} in {good} of "
        f"{len(trials)}",
        "",
        "",
        f"<= {MEDIAN:.0%}, >= {INSIDE:.0%}, <= {60 * MINUTES:.0f} s, >= {GOOD:.0%}",
        reached,
        f"{LOGS} logs of {SECONDS:g} s, {1 / CONTROL_DT:g} rows per second, encoders of 12 bits; {count} values, of "
        f"which {unknown} are not known",
    )


arm = partial(_row, "arm")
quadruped = partial(_row, "quadruped")
