"""Plays episodes of an environment in MuJoCo in which joints are moved, and reads the answers of the motors."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.instance import Instance
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.mujoco_worlds import library, read_commands
from rlctl.checking.rule import list_names
from rlctl.checking.worlds import Array, Joint, JointActuator
from rlctl.environments.simulations import find_mujoco


@dataclasses.dataclass
class PlayedMotors:
    """What an episode wrote for the motors, call by call of the physics, and how many calls there were by each step."""

    start: Array  # qpos after reset
    controls: list[Array] = dataclasses.field(default_factory=list)
    calls: list[int] = dataclasses.field(default_factory=list)  # by step; that of reset first

    def read_first(self, step: int) -> Array | None:
        """Return the first command of a step, counted from 1; None if it was not played or called no physics."""
        has_called = len(self.calls) > step and self.calls[step] > self.calls[step - 1]
        return self.controls[self.calls[step - 1]] if has_called else None


class MotorTrial:
    """Plays episodes in which joints are moved."""

    def __init__(self, instance: Instance, calls: MujocoCalls, motors: Sequence[JointActuator]) -> None:
        self.instance, self.motors, self._calls = instance, motors, calls
        self.joints: list[Joint] = list({motor.joint.index: motor.joint for motor in motors}.values())
        numbers = [joint.index for joint in self.joints]
        self.own = [numbers.index(motor.joint.index) for motor in motors]  # the place of each motor's joint

    def is_over(self) -> bool:
        """Say whether time ran out."""
        return self.instance.context.budget.is_over()

    def play(
        self, seed: int, actions: Sequence[Any] | None = None, steps: int = 0, after: int = 0, move: Array | None = None
    ) -> PlayedMotors:
        """Play an episode of given actions, or of so many random ones. After a number of calls of the physics,
        positions and speeds change by `move`, shape (nq + nv,)."""
        played = PlayedMotors(np.zeros(0))
        done = 0

        def note(_: Any, data: Any, nstep: int) -> None:
            played.controls.append(read_commands(data, self.motors))

        def change(model: Any, data: Any) -> None:
            if move is not None and done == after:
                data.qpos[:] += move[: model.nq]
                data.qvel[:] += move[model.nq :]
                library().mj_forward(model, data)

        def count(model: Any, data: Any) -> None:
            nonlocal done
            done += 1
            change(model, data)

        self._calls.before_step, self._calls.after_step = note, count
        try:
            steps = steps if actions is None else len(actions)
            for moment in EpisodePlayer(self.instance, seed, max_steps=steps, sequence=actions):
                simulation = find_mujoco(self.instance.env)
                if moment.step == 0 and simulation is not None:
                    played.start = simulation[1].qpos.copy()
                    if done == 0:  # no step of the physics in reset, after which joints could be moved
                        change(*simulation)
                played.calls.append(done)
        finally:
            self._calls.before_step, self._calls.after_step = MujocoCalls.before_step, MujocoCalls.after_step
        return played

    def find_places(self) -> tuple[NDArray[np.intp], NDArray[np.intp], int]:
        """Return where in `move` the positions and the speeds of the joints are, and its size."""
        simulation = find_mujoco(self.instance.env)
        assert simulation is not None  # it was played
        model, joints = simulation[0], [joint.index for joint in self.joints]
        return model.jnt_qposadr[joints], model.nq + model.jnt_dofadr[joints], int(model.nq + model.nv)

    def find_exchanged(self, answers: NDArray[np.bool_]) -> dict[int, int]:
        """Return the place of the joint that a motor answers, by motor, where some motors answer each other's joints
        and nothing else. `answers` has a row per motor and a column per joint."""
        rows, columns = answers.sum(axis=1), answers.sum(axis=0)
        single = {m: int(answers[m].argmax()) for m in np.flatnonzero(rows == 1).tolist()}
        other = {m: joint for m, joint in single.items() if joint != self.own[m] and columns[joint] == 1}
        is_closed = {self.own[m] for m in other} == set(other.values())
        return other if len(other) >= 2 and is_closed else {}

    def name_others(self, exchanged: Mapping[int, int]) -> str:
        """Return the motors after the first one, and what they answer."""
        pairs = [
            f"ctrl[{self.motors[motor].number}] that of {self.joints[joint].name}" for motor, joint in exchanged.items()
        ]
        return f"; {list_names(pairs[1:])}"
