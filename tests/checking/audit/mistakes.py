"""Ten mistakes of rewards as public trackers report them, made again on two robots, each with a twin that is sound."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from rlctl.task import Box, CommandTerm, Sim, Task, rewards
from rlctl.task.rotations import rotate_inverse

JOINTS = [f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "upper", "lower")]
FEET = ("FR_toe", "FL_toe", "RR_toe", "RL_toe")
STANCE = np.array([0.0, 0.8, -1.6] * 4)  # [rad]
DOWN = (0.0, 0.0, -1.0)


@dataclass
class Legs(Task):
    """A robot with four legs that follows velocity commands."""

    episode_s: float = 1.2

    robot = "Unitree A1"
    control_dt, substeps = 0.02, 4
    action_space = Box(-1.0, 1.0, (12,), np.float32)
    ends_at_fall: ClassVar[bool] = True
    scale: ClassVar[float] = 0.25  # [m/s]; so far from the command, tracking is worth 1/e

    def build(self, sim: Sim) -> None:
        self.ground = sim.load("ground", "plane.urdf", fixed=True)
        self.body = sim.load("robot", "a1.urdf", position=(0.0, 0.0, 0.3))
        self.joints = self.body.find_joints(JOINTS)

    def reset(self, rng: np.random.Generator) -> None:
        self.body.set_base((0.0, 0.0, 0.29))
        self.body.set_joints(STANCE)
        self.command = rng.uniform((-0.8, -0.4, -0.8), (1.0, 0.4, 0.8))
        self.steps, self.error_sum = 0, 0.0
        self.update()

    def act(self, action: np.ndarray) -> None:
        self.body.drive_to(STANCE + 0.5 * action, gain=0.25)
        self.steps += 1

    def update(self) -> None:
        orientation = self.body.base_orientation
        self.velocity = rotate_inverse(orientation, self.body.base_velocity)
        self.turning = rotate_inverse(orientation, self.body.base_angular_velocity)
        self.gravity = rotate_inverse(orientation, DOWN)
        self.height = float(self.body.base_position[2])
        self.fallen = bool(self.gravity[2] > -0.5 or self.height < 0.12)

    def is_terminated(self) -> bool:
        self.update()
        self.error = float(np.linalg.norm(self.command[:2] - self.velocity[:2]))
        self.error_sum += self.error
        return self.ends_at_fall and self.fallen

    def observe(self) -> dict[str, np.ndarray]:
        return {"gravity": self.gravity, "command": self.command, "joints": self.body.joint_positions}

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        return {name: float(getattr(self, f"pay_{name}")()) for name in self.reward_weights}

    def pay_tracking(self) -> float:
        return rewards.closeness(self.error, self.scale)

    def pay_turning(self) -> float:
        return rewards.closeness(float(self.command[2] - self.turning[2]), self.scale)

    def pay_alive(self) -> float:
        return rewards.alive(self.fallen)

    def pay_fall(self) -> float:
        return float(self.fallen)

    def pay_torque(self) -> float:
        return rewards.squared(self.body.joint_torques[self.joints])

    def pay_progress(self) -> float:
        """Along the command, and no more than is commanded."""
        wanted = float(np.linalg.norm(self.command[:2]))
        return min(float(self.velocity[:2] @ self.command[:2]) / wanted, wanted)

    def pay_unsigned_progress(self) -> float:
        return abs(self.pay_progress())

    def pay_air_time(self) -> float:
        return len(FEET) - len(self.body.links_touching(self.ground).intersection(FEET))

    def pay_air_time_moving(self) -> float:
        return self.pay_air_time() if np.linalg.norm(self.velocity[:2]) > 0.2 else 0.0

    def pay_clearance(self) -> float:
        """As near to the swing's height as feet are that move: of feet that do not move it is 1."""
        return float(np.exp(-10.0 * self.missing_clearance()))

    def missing_clearance(self) -> float:
        moving = float(np.abs(self.body.joint_velocities[self.joints]).mean())
        return moving * float(np.mean([abs(self.body.link_position(foot)[2] - 0.08) for foot in FEET]))

    def pay_lowness(self) -> float:
        return self.missing_clearance()

    def pay_upside_down(self) -> float:
        return 1.0 + float(self.gravity[2])

    def pay_upright(self) -> float:
        return max(-float(self.gravity[2]), 0.0)

    def is_success(self) -> bool:
        return not self.fallen and self.error_sum <= 0.2 * max(self.steps, 1)

    def commands(self) -> dict[str, CommandTerm]:
        x, y, z = self.command.tolist()
        return {
            "lin_vel_x": CommandTerm(x, -0.8, 1.0, "m/s"),
            "lin_vel_y": CommandTerm(y, -0.4, 0.4, "m/s"),
            "ang_vel_z": CommandTerm(z, -0.8, 0.8, "rad/s"),
        }

    def set_commands(self, values: Mapping[str, float]) -> None:
        self.command = np.array(list(values.values()))

    def describe_joints(self) -> Any:
        return self.body.describe_joints(JOINTS, default_positions=STANCE.tolist(), action_scale=0.5)


class PaidForLiving(Legs):
    """Being up pays ten times what following pays: https://github.com/isaac-sim/IsaacLab/issues/458."""

    reward_weights = {"tracking": 0.1, "turning": 0.05, "alive": 1.0, "torque": -1e-5}


class PaidForFollowing(Legs):
    reward_weights = {"tracking": 1.0, "turning": 0.5, "alive": 0.2, "torque": -1e-5}


class CostsMoreThanItPays(Legs):
    """All rewards are negative, so short episodes are best: https://github.com/openai/roboschool/issues/50."""

    reward_weights = {"tracking": 0.5, "torque": -0.05}


class PaysMoreThanItCosts(Legs):
    reward_weights = {"tracking": 0.5, "torque": -1e-4, "fall": -2.0}


class WideKernel(Legs):
    """A kernel that hardly falls: https://github.com/pollen-robotics/microduck_rl/issues/46 ends in standing."""

    scale = 4.0
    reward_weights = {"tracking": 1.0, "turning": 0.2, "fall": -1.0}


class NarrowKernel(Legs):
    reward_weights = {"tracking": 1.0, "turning": 0.2, "fall": -1.0}


class UnsignedProgress(Legs):
    """Progress loses its sign, so the reverse pays too: https://github.com/axelbr/racecar_gym/pull/23."""

    reward_weights = {"unsigned_progress": 2.0, "alive": 0.1}


class SignedProgress(Legs):
    reward_weights = {"progress": 2.0, "alive": 0.1}


class PaidForSteps(Legs):
    """Time in the air pays whether the robot moves or not: https://github.com/pollen-robotics/microduck_rl/issues/46."""

    reward_weights = {"tracking": 0.1, "air_time": 1.0, "fall": -1.0}


class PaidForStepsThatMove(Legs):
    reward_weights = {"tracking": 1.0, "air_time_moving": 0.2, "fall": -1.0}


class ClearanceOfStillFeet(Legs):
    """exp(-0) pays in full for feet that stand: https://github.com/unitreerobotics/unitree_rl_lab/pull/80."""

    reward_weights = {"tracking": 0.1, "clearance": 1.0, "fall": -1.0}


class ClearanceCosts(Legs):
    reward_weights = {"tracking": 1.0, "lowness": -1.0, "fall": -1.0}


class UprightReversed(Legs):
    """The sign of projected gravity is mistaken, so lying on the back pays: https://github.com/leggedrobotics/legged_gym."""

    ends_at_fall = False
    reward_weights = {"tracking": 1.0, "upside_down": 2.0}


class Upright(Legs):
    ends_at_fall = False
    reward_weights = {"tracking": 1.0, "upright": 0.3}


HOME = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.9, 0.0])  # [rad]
HAND = "lbr_iiwa_link_7"
STEP = 0.03  # [rad]


@dataclass
class Arm(Task):
    """An arm that brings its hand to a goal."""

    episode_s: float = 1.5

    robot = "KUKA LBR iiwa"
    control_dt, substeps, solver_iterations = 4 / 240, 4, 10
    action_space = Box(-1.0, 1.0, (7,), np.float32)
    ends_at_goal: ClassVar[bool] = False
    tolerance: ClassVar[float] = 0.05  # [m]

    def build(self, sim: Sim) -> None:
        self.arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)

    def reset(self, rng: np.random.Generator) -> None:
        self.arm.set_joints(HOME)
        self.goal = rng.uniform((0.5, 0.15, 0.2), (0.6, 0.3, 0.4))
        self.distance = self.last = self.measure()

    def measure(self) -> float:
        return rewards.distance(self.arm.link_position(HAND), self.goal)

    def act(self, action: np.ndarray) -> None:
        self.action = action
        self.arm.drive_to(self.arm.joint_positions + STEP * action, gain=0.25)

    def is_terminated(self) -> bool:
        self.last, self.distance = self.distance, self.measure()
        return self.ends_at_goal and self.is_success()

    def observe(self) -> dict[str, np.ndarray]:
        return {"joints": self.arm.joint_positions, "to_goal": self.goal - self.arm.link_position(HAND)}

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        return {name: float(getattr(self, f"pay_{name}")()) for name in self.reward_weights}

    def pay_distance(self) -> float:
        return self.distance

    def pay_near(self) -> float:
        return rewards.closeness(self.distance, 0.3)

    def pay_reached(self) -> float:
        return float(self.is_success())

    def pay_approach(self) -> float:
        return self.last - self.distance

    def pay_movement(self) -> float:
        return abs(self.last - self.distance)

    def pay_action(self) -> float:
        return rewards.squared(self.action)

    def is_success(self) -> bool:
        return self.measure() < self.tolerance

    def markers(self) -> dict[str, np.ndarray]:
        return {"goal": self.goal}

    def describe_joints(self) -> Any:
        return self.arm.describe_joints(self.arm.joint_names, action_step=STEP, measured="joints")


class EndsAtTheGoal(Arm):
    """Success ends what pays, so it stops beside the goal: https://github.com/Farama-Foundation/Metaworld/issues/378."""

    ends_at_goal = True
    reward_weights = {"near": 1.0, "reached": 10.0, "action": -0.01}


class StaysAtTheGoal(Arm):
    reward_weights = {"near": 1.0, "reached": 1.0, "action": -0.01}


class PaidForMovement(Arm):
    """Any change of the distance pays: https://github.com/DarkAutumn/triforce/pull/26."""

    reward_weights = {"movement": 10.0, "reached": 0.02}


class PaidForApproach(Arm):
    reward_weights = {"approach": 10.0, "reached": 0.02}


class ActionsCostTooMuch(Arm):
    """Cost of actions above what moving gains: https://github.com/bulletphysics/bullet3/issues/2592."""

    reward_weights = {"distance": -1.0, "action": -8.0}


class ActionsCostLittle(Arm):
    reward_weights = {"distance": -1.0, "action": -0.02}


class RaisesAtFullAction(StaysAtTheGoal):
    def act(self, action: np.ndarray) -> None:
        if np.abs(action).min() == 1.0:
            raise ValueError("too much")
        super().act(action)
