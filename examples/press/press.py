"""Press: an arm presses on a table with a given force. Shows a force-torque sensor, contact forces and a camera."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import Attachment, Box, Sim, Task, rewards

FOLDER = Path(__file__).parent
HAND = "lbr_iiwa_link_7"
WRIST = "lbr_iiwa_joint_7"
DOWN = (0.0, 1.0, 0.0, 0.0)  # quaternion: the hand's z axis points to the floor
PLACE = np.array([0.55, 0.0])  # [m], x and y
TABLE = 0.2  # [m], height of its top, as in its file
PAD = 0.05  # [m], edge of the cube under the hand, as in its file
FLANGE = 0.05  # [m], from the hand's frame to the end of its shape, with a small gap
STEP = 0.001  # [m], motion of the hand's target per control step at action 1
LIMIT = 60.0  # [N], more would break the table
CAMERA_STEPS = 6  # control steps between two pictures: 10 Hz


@dataclass
class Press(Task):
    """Press on the table with `force` [N]; more than 60 N is penalised."""

    force: float = 20.0  # [N]

    robot = "KUKA LBR iiwa with a pad"
    control_dt, substeps, episode_s = 1 / 60, 4, 3.0  # [s], -, [s]
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    action_meaning = "the hand's way down; 1 is 1 mm"
    observation_layout = "dict"
    observation_units = {"height": "m", "wrist_force": "N"}
    reward_weights = {"gap": -5.0, "pressing": 1.0, "excess_force": -0.1, "penetration": -10.0, "action": -0.01}

    def build(self, sim: Sim) -> None:
        self.table = sim.load("table", FOLDER / "table.urdf", position=(0.9, 0.0, 0.0), fixed=True)
        self.arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        self.arm.set_joints(np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.9, 0.0]))
        self.start = TABLE + PAD + FLANGE + 0.02  # [m], of the hand: 2 cm above the table
        for _ in range(5):  # each search starts where the last one ended
            self.arm.set_joints(self.solve(self.start))
        self.home = self.arm.joint_positions.copy()
        # The pad is a body of its own that is held under the hand.
        height = self.arm.link_position(HAND)[2] - FLANGE - PAD / 2
        self.pad = sim.load("pad", FOLDER / "pad.urdf", position=(*PLACE, height))
        under = Attachment(self.arm, HAND, (0.0, 0.0, FLANGE + PAD / 2), DOWN)
        sim.connect_fixed(under, Attachment(self.pad, self.pad.base_name))
        self.arm.add_force_sensor(WRIST)

    def solve(self, height: float) -> np.ndarray:
        """Return the joint angles [rad] that bring the hand to a height [m] above the place."""
        return self.arm.solve_inverse_kinematics(HAND, (*PLACE, height), DOWN)

    def reset(self, rng: np.random.Generator) -> None:
        self.target = self.start + rng.uniform(-0.01, 0.01)
        self.arm.set_joints(self.home)
        self.steps = 0

    def act(self, action: np.ndarray) -> None:
        self.steps += 1
        self.target = float(np.clip(self.target - STEP * action[0], self.start - 0.05, self.start + 0.05))
        self.arm.drive_to(self.solve(self.target))  # with the speeds and forces of the model file

    def observe(self) -> dict[str, np.ndarray]:
        if self.steps % CAMERA_STEPS == 0:
            eye = (PLACE[0] + 0.5, PLACE[1] + 0.5, TABLE + 0.2)
            self.picture = self.sim.render(64, 48, eye=eye, target=(*PLACE, TABLE))
        # After a reset there is no measurement yet.
        force = self.arm.joint_reaction(WRIST)[:3] if self.steps else np.zeros(3)
        height = np.array([self.target, self.arm.link_position(HAND)[2]])
        return {"height": height, "wrist_force": force, "camera": self.picture}

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        contacts = self.pad.contacts_with(self.table)
        return {
            "gap": max(0.0, self.pad.distance_to(self.table)),
            "pressing": rewards.closeness(contacts.forces.sum() - self.force, 10.0) if contacts.links else 0.0,
            "excess_force": rewards.excess_force(contacts.forces, LIMIT),
            "penetration": rewards.penetration(contacts.distances),
            "action": rewards.squared(action),
        }

    def is_success(self) -> bool:
        return abs(self.pad.contacts_with(self.table).forces.sum() - self.force) < 5.0
