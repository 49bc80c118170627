"""RL824: controller pushes away."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiments.worlds import MujocoTrials, judges_trials
from rlctl.checking.motor_trials import MotorTrial, PlayedMotors
from rlctl.checking.mujoco_worlds import MujocoStateReader, copy_data, library
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.worlds import Array
from rlctl.environments.simulations import find_mujoco

RULE = Rule(
    "RL824",
    "controller pushes away",
    Severity.WARNING,
    meaning="""
        The environment computes forces of motors from the positions or the speeds of their joints, with the wrong
        sign: in MuJoCo the check moved a joint by hand, and its motor pushed it further away, harder than what
        weight or friction could ask for. The joint runs into its limit or starts to shake, whatever the action is.
    """,
    fix="""
        A force is stiffness * (target - position) - damping * speed. With a negative gear of the actuator, or a
        joint whose axis points the other way, change both.
    """,
    shows_one=True,
)

MOVES = (0.02, -0.02, 0.3)  # of a joint [rad], [m], or of its speed: by more, where a force that is clipped is the same
BEYOND = 3.0  # times what weight or friction could ask for
LEAST = 1e-6  # [N m/rad]


@judges_trials(RULE, place=45)
def _find_wrong_signs(trials: MujocoTrials) -> Iterator[RuleFinding]:
    trial = MotorTrial(trials.instance, trials.calls, trials.reader.world.motors)
    is_force = np.array([not motor.holds_position for motor in trial.motors])
    if not is_force.any() or "RL811" in trials.found:
        return
    plain = trial.play(FIRST_SEED, steps=1)
    positions, speeds, size = trial.find_places()
    stiffness, damping = _measure_physics(trials.reader, trial, plain)
    for places, what, physics, own_gain in ((positions, "position", stiffness, 1), (speeds, "speed", damping, 2)):
        if not _measure_answer(trial, plain, places, size).any():
            continue
        own_answers = _read_own_answers(trial, own_gain)
        wrong: dict[int, float] = {}
        for joint in range(len(trial.joints)):
            answers = _measure_answer(trial, plain, places[[joint]], size)
            own = is_force & (np.array(trial.own) == joint)
            others = float(np.abs(answers[~own]).max(initial=0.0))
            if BEYOND * others > np.abs(answers[own]).max(initial=0.0):
                continue  # no controller of single joints, with their weight perhaps
            for motor in np.flatnonzero(own & (answers != 0)).tolist():
                force = (answers[motor] + own_answers[motor]) * trial.motors[motor].gear
                if force > BEYOND * physics[joint] + LEAST:
                    wrong[motor] = force
        if wrong and not trial.is_over():
            yield _describe(trial, wrong, what)
            return


def _measure_answer(trial: MotorTrial, plain: PlayedMotors, places: NDArray[np.intp], size: int) -> Array:
    """Return how the first commands change after some joints were moved at the start, per unit; 0 where they do not.
    Shape (motors,)."""
    answers = np.zeros(len(trial.motors))
    before = plain.read_first(1)
    for change in MOVES:
        if before is None or trial.is_over() or answers.any():
            break
        move = np.zeros(size)
        move[places] = change
        after = trial.play(FIRST_SEED, steps=1, after=plain.calls[0], move=move).read_first(1)
        if after is not None:
            answers = np.nan_to_num(after - before) / change
    return answers


def _read_own_answers(trial: MotorTrial, gain: int) -> Array:
    """Return by how much each actuator's own controller adds to its input, per unit of its joint; it may be a spring
    from the first command on, with the target as a force. Shape (motors,)."""
    simulation = find_mujoco(trial.instance.env)
    assert simulation is not None  # it was played
    own: Array = simulation[0].actuator_biasprm[[motor.number for motor in trial.motors], gain]
    return own * [motor.gear for motor in trial.motors]


def _measure_physics(reader: MujocoStateReader, trial: MotorTrial, plain: PlayedMotors) -> tuple[Array, Array]:
    """Return by how much the weight on each joint changes with its position, and the damping that it has, which a
    controller may balance. Shape (joints,) each."""
    model, data = reader.model, library().MjData(reader.model)
    copy_data(data, model, reader.data)
    data.qvel[:] = 0.0
    weights = []
    for joint in [None, *trial.joints]:
        data.qpos[:] = plain.start
        if joint is not None:
            data.qpos[model.jnt_qposadr[joint.index]] += MOVES[0]
        library().mj_fwdPosition(model, data)
        library().mj_fwdVelocity(model, data)
        weights.append(data.qfrc_bias - data.qfrc_passive)
    places = [model.jnt_dofadr[joint.index] for joint in trial.joints]
    changes = [abs(moved[place] - weights[0][place]) for moved, place in zip(weights[1:], places, strict=True)]
    return np.array(changes) / MOVES[0], np.array(model.dof_damping[places])


def _describe(trial: MotorTrial, wrong: dict[int, float], what: str) -> RuleFinding:
    motor, force = next(iter(wrong.items()))
    joint = trial.motors[motor].joint
    others = [trial.motors[other].joint.name for other in list(wrong)[1:]]
    more = f"; so do those of {list_names(others)}" if others else ""
    units = {"position": ("N m/rad", "N/m"), "speed": ("N m s/rad", "N s/m")}[what]
    unit = units[0] if joint.is_angle else units[1]
    message = f"the motor of joint {joint.name} pushes in the direction of its {what}, by {force:.3g} {unit}{more}"
    evidence = {"seed": FIRST_SEED, "element": joint.name, "value": force, "expected": "below 0"}
    return RuleFinding(RULE, message, evidence)
