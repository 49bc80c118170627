"""A robot on two wheels that is to go to a place on the ground."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import Box, Sim, Task
from rlctl.task.rotations import rotate_inverse

WHEEL = """<body name="{name}" pos=".05 {y} -.02"><joint name="{name}" axis="0 1 0" damping=".01"/>
<geom type="cylinder" size=".08 .02" euler="1.5708 0 0" mass=".3"/></body>"""
MODEL = f"""<mujoco model="rover"><compiler angle="radian"/>
<worldbody><body name="chassis" pos="0 0 .1"><freejoint/><geom type="box" size=".18 .12 .04" mass="3"/>
<geom type="sphere" size=".03" pos="-.15 0 -.07" mass=".1" friction="0.01 .001 .0001"/>
{WHEEL.format(name="left", y=0.15)}{WHEEL.format(name="right", y=-0.15)}</body></worldbody></mujoco>"""


@dataclass
class Rover(Task):
    """Drive to a place."""

    episode_s: float = 6.0

    robot = "rover"
    control_dt, substeps = 0.04, 4
    action_space = Box(-1.0, 1.0, (2,), np.float32)
    reward_weights = {"distance": -1.0}

    def build(self, sim: Sim) -> None:
        sim.load("ground", "plane.urdf", fixed=True)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "rover.xml")
            file.write_text(MODEL)
            self.body = sim.load("robot", str(file), position=(0.0, 0.0, 0.1))

    def reset(self, rng: np.random.Generator) -> None:
        self.body.set_base((0.0, 0.0, 0.101))
        angle = rng.uniform(-np.pi, np.pi)
        self.goal = rng.uniform(0.6, 1.2) * np.array([np.cos(angle), np.sin(angle)])

    def act(self, action: np.ndarray) -> None:
        self.body.drive_at(12.0 * action, max_force=2.0)

    def to_goal(self) -> np.ndarray:
        return np.array([*(self.goal - self.body.base_position[:2]), 0.0])

    def observe(self) -> dict[str, np.ndarray]:
        return {"to_goal": rotate_inverse(self.body.base_orientation, self.to_goal())[:2]}

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        return {"distance": float(np.linalg.norm(self.to_goal()))}

    def is_success(self) -> bool:
        return bool(np.linalg.norm(self.to_goal()) < 0.15)
