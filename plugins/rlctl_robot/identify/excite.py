"""An informative trajectory within a robot's limits: each action is a sum of sines."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from rlctl import output
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, UsageError
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl_robot.identify.follow import describe_expected, find_joints, open_world
from rlctl_robot.identify.log import MIN_ROWS, Array, Log, write_log
from rlctl_robot.identify.targets import read_targets, remembers_targets

_LOWEST_HZ, _HIGHEST_HZ = 0.2, 2.5
_SINES = 5  # per action, each with frequencies of its own
_AMPLITUDES = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.15, 0.1, 0.05)
_MARGIN = 0.1  # of a joint's range that is left at both ends
_FADE_S = 0.5


@dataclasses.dataclass(frozen=True)
class Excitation:
    """A trajectory that was simulated without leaving the limits."""

    path: Path
    task: str
    seconds: float
    amplitude: float  # fraction of the action range that it uses
    largest_share: float  # largest used fraction of a joint's range without its margins; 0 if no joint has limits


def write_excitation(spec: EnvSpec, path: Path, *, seconds: float, seed: int) -> Excitation:
    """Write the largest trajectory that is safe in simulation as a log: the actions and the simulated joint states.

    Safe: every joint stays 10 % of its range away from its ends and below its top speed, no body that is fixed to the
    world touches another one, and the task does not end. Raises `AnswerIsNo` if even 5 % of the action range is unsafe,
    `UsageError` for unbounded actions or a trajectory that is too short.
    """
    with contextlib.closing(open_world(spec)) as env:
        if not np.isfinite([env.action_space.low, env.action_space.high]).all():  # type: ignore[attr-defined]
            raise UsageError(f"{spec.task}: its actions have no bounds; --excite scales its trajectory by them")
        if (steps := round(seconds / env.task.control_dt)) < MIN_ROWS:
            raise UsageError(f"--seconds {seconds:g}: {steps} actions of {spec.task}; a log needs at least {MIN_ROWS}")
        expected = describe_expected(env, spec.task)
        # No random events: they would only disturb the motion.
        env.set_events(EventSettings())
        shape = _draw_sines(env, steps, seed)
        for amplitude in _AMPLITUDES:
            reason, log, share = _play(env, amplitude * shape, expected.driven)
            if not reason:
                write_log(path, log, expected)
                return Excitation(path, spec.task, seconds, amplitude, share)
        raise AnswerIsNo(
            f"{spec.task}: no safe trajectory found: even at {_AMPLITUDES[-1]:.0%} of the action range, {reason}"
        )


def show_excitation(result: Excitation, json: str | None) -> None:
    """Print the trajectory's file and how much of the ranges it uses."""
    if output.present(result, json):
        return
    output.out().print(
        f"{result.path}: {result.seconds:g} s for {result.task}, {result.amplitude:.0%} of the action range\n"
        f"in simulation the joints use {result.largest_share:.0%} of their range (without margins), touch nothing "
        "and stay below their top speeds; the robot's cables and surroundings are not simulated\n"
        f"play its actions on the robot, log the same columns, then: rlctl identify {result.task} --log FILE"
    )


def _draw_sines(env: TaskEnv, steps: int, seed: int) -> Array:
    """Return a trajectory of shape (steps, actions) in [-1, 1], the action range, that begins and ends at 0."""
    rng = np.random.default_rng(seed)
    count = int(np.prod(env.action_space.shape or ()))
    time = np.arange(steps)[:, None] * env.task.control_dt
    total = np.zeros((steps, count))
    for _ in range(_SINES):
        hertz = np.exp(rng.uniform(np.log(_LOWEST_HZ), np.log(_HIGHEST_HZ), count))
        total += np.sin(2 * np.pi * hertz * time + rng.uniform(0, 2 * np.pi, count))
    fade = max(1, round(_FADE_S / env.task.control_dt))
    total *= np.minimum(1.0, np.minimum(np.arange(steps), np.arange(steps)[::-1])[:, None] / fade)
    return total / np.abs(total).max(axis=0)


def _play(env: TaskEnv, trajectory: Array, driven: tuple[str, ...]) -> tuple[str, Log, float]:
    """Play a trajectory; return why it is unsafe (or empty), the log, and the largest fraction of a range."""
    all_joints = find_joints(env)
    joints = {name: all_joints[name] for name in driven or all_joints}
    low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
    middle = np.clip(np.zeros_like(low), low, high)
    steps_targets = remembers_targets(env)
    env.reset(seed=0)
    actions, measured, targets, share, reason = [], [], [], 0.0, ""
    for row in trajectory:
        side = row.reshape(low.shape)
        action = (middle + np.where(side > 0, side * (high - middle), side * (middle - low))).astype(low.dtype)
        actions.append(action.ravel())
        measured.append([(body.joint_positions[i], body.joint_velocities[i]) for body, i in joints.values()])
        if steps_targets:
            targets.append(read_targets(env))
        env.act(action)
        env.sim.step()
        reason, reached = _find_danger(env, joints)
        share = max(share, float(reached))
        if reason:
            break
    arrays = np.array(measured, np.float64)
    log = Log(
        tuple(joints), np.array(actions), arrays[:, :, 0], arrays[:, :, 1], np.array(targets) if steps_targets else None
    )
    return reason, log, share


def _find_danger(env: TaskEnv, joints: dict[str, tuple[Any, int]]) -> tuple[str, float]:
    """Return why the present state is unsafe (or empty), and the largest used fraction of a joint's range."""
    largest = 0.0
    for name, (body, index) in joints.items():
        low, high, limit = body.joint_low[index], body.joint_high[index], body.joint_max_speed[index]
        position, speed = body.joint_positions[index], abs(body.joint_velocities[index])
        if low < high and np.isfinite(high - low):
            middle, half = (low + high) / 2, (high - low) * (0.5 - _MARGIN)
            largest = max(largest, abs(position - middle) / half)
            if largest > 1:
                return f"joint {name} comes near the end of its range", largest
        if limit > 0 and speed > 1.05 * limit:
            return f"joint {name} is faster than its top speed, {limit:.3g} rad/s", largest
    if env.is_terminated():
        return "the episode ends", largest
    for body in {id(body): body for body, _ in joints.values() if body.fixed}.values():
        for other in env.sim.bodies.values():
            if other is not body and (touching := body.links_touching(other)):
                return f"{sorted(touching)[0]} touches {other.name}", largest
    return "", largest
