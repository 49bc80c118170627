"""Reach as tutorials write it, to measure against: the same task, none of the care.

Models are loaded again at each reset, each physics step is a call, each joint is commanded and read by itself.
`check_same_task` holds it to the task that is shipped.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

import rlctl
from rlctl.task.bullet import pybullet as p
from rlctl.task.model_files import MODELS
from rlctl_manipulation import reach

JOINTS, HAND = 7, 6  # number of joints; index of the hand's link


class TutorialReach(gymnasium.Env[np.ndarray, np.ndarray]):
    """The KUKA arm reaches for a goal."""

    def __init__(self) -> None:
        self.task = reach.Reach()
        self.client = p.connect(p.DIRECT)
        self.action_space = spaces.Box(-1.0, 1.0, (JOINTS,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2 * JOINTS + 6,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        p.resetSimulation(physicsClientId=self.client)
        p.setAdditionalSearchPath(str(MODELS), physicsClientId=self.client)
        p.setGravity(0, 0, -9.81, physicsClientId=self.client)
        p.setTimeStep(self.task.control_dt / self.task.substeps, physicsClientId=self.client)
        # Tutorials leave it at 50; the same physics makes the comparison one of how it is written.
        iterations = self.task.solver_iterations
        p.setPhysicsEngineParameter(numSolverIterations=iterations, physicsClientId=self.client)
        p.loadURDF("plane.urdf", physicsClientId=self.client)
        inertia = p.URDF_USE_INERTIA_FROM_FILE  # as the shipped task; tutorials leave it out
        self.arm = p.loadURDF("kuka_iiwa.urdf", useFixedBase=True, flags=inertia, physicsClientId=self.client)
        start = reach.HOME + self.np_random.uniform(-reach.HOME_NOISE, reach.HOME_NOISE, JOINTS)
        p.changeDynamics(self.arm, -1, maxJointVelocity=reach.SPEED_LIMIT.max(), physicsClientId=self.client)
        for joint in range(JOINTS):
            p.resetJointState(self.arm, joint, start[joint], physicsClientId=self.client)
        self.goal = self.np_random.uniform(reach.GOAL_LOW, reach.GOAL_HIGH)
        self.last_action = np.zeros(JOINTS, np.float32)
        self.steps = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        action = np.clip(action, -1.0, 1.0)
        for joint in range(JOINTS):
            info = p.getJointInfo(self.arm, joint, physicsClientId=self.client)
            position = p.getJointState(self.arm, joint, physicsClientId=self.client)[0]
            target = position + reach.JOINT_STEP[joint] * action[joint]
            p.setJointMotorControl2(
                self.arm,
                joint,
                p.POSITION_CONTROL,
                targetPosition=np.clip(target, info[8], info[9]),
                force=info[10],
                maxVelocity=reach.MAX_SPEED[joint],
                positionGain=reach.GAIN,
                physicsClientId=self.client,
            )
        for _ in range(self.task.substeps):
            p.stepSimulation(physicsClientId=self.client)
        self.steps += 1
        distance = float(np.linalg.norm(self._hand() - self.goal))
        change, self.last_action = action - self.last_action, action
        terms = {
            "distance": distance,
            "reached": float(np.exp(-((distance / self.task.tolerance) ** 2))),
            "action": float(np.mean(action**2)),
            "smoothness": float(np.mean(change**2)),
        }
        reward = sum(weight * terms[name] for name, weight in self.task.reward_weights.items())
        info = {"is_success": distance < self.task.tolerance}
        return self._observation(), reward, False, self.steps >= self.task.max_steps, info

    def _hand(self) -> np.ndarray:
        return np.array(p.getLinkState(self.arm, HAND, computeForwardKinematics=1, physicsClientId=self.client)[4])

    def _observation(self) -> np.ndarray:
        states = [p.getJointState(self.arm, joint, physicsClientId=self.client) for joint in range(JOINTS)]
        positions, velocities = [state[0] for state in states], [state[1] for state in states]
        hand = self._hand()
        return np.concatenate([positions, velocities, hand, self.goal - hand]).astype(np.float32)

    def close(self) -> None:
        p.disconnect(self.client)


def check_same_task() -> None:
    """Raise `RuntimeError` unless an episode begins the same here and in the shipped task, rewards included."""
    ours, theirs = rlctl.make("reach"), TutorialReach()
    same = np.allclose(ours.reset(seed=1)[0], theirs.reset(seed=1)[0], atol=1e-6)
    # Not for longer: small differences of the solver's settings grow.
    for action in np.random.default_rng(1).uniform(-1.5, 1.5, (20, JOINTS)).astype(np.float32):
        observation, reward, *_, info = ours.step(action)
        other_observation, other_reward, *_, other_info = theirs.step(action)
        same &= np.allclose(observation, other_observation, atol=0.02) and abs(reward - other_reward) < 1e-3
        same &= info["is_success"] == other_info["is_success"]
    ours.close()
    theirs.close()
    if not same:
        raise RuntimeError("tests/benchmarks/tutorial_env.py is not the task of reach.py any more: bring it up to date")
