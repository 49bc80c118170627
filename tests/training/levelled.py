"""Tasks of five steps that observe their level and succeed up to level 0.6."""

from dataclasses import dataclass

import numpy as np

from rlctl.task import BatchTask, Box, Sim, Task, WorldRngs


class Unjudged(Task):
    """The level is all there is."""

    control_dt, substeps, episode_s = 0.02, 1, 0.1
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"still": 1.0}

    def build(self, sim: Sim) -> None:
        self.ground = sim.load("ground", "plane.urdf", fixed=True)

    def act(self, action: np.ndarray) -> None:
        pass

    def observe(self) -> dict[str, np.ndarray]:
        return {"level": np.array([self.level])}

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        return {"still": 0.0}


class Levelled(Unjudged):
    def is_success(self) -> bool:
        return bool(self.level <= 0.6)


@dataclass
class LevelledBatch(BatchTask):
    """The same, in many worlds; it breaks in the third step at `faulty_level`."""

    faulty_level: float = -1.0

    control_dt, substeps, episode_s = 0.02, 1, 0.1
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"still": 1.0}
    per_world = {"steps": ()}

    def build(self, sim: Sim) -> None:
        self.ground = sim.load("ground", "plane.urdf", fixed=True)

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        assert len(self.level[worlds]) == len(worlds)

    def act(self, action: np.ndarray) -> None:
        self.steps += 1

    def observe(self) -> dict[str, np.ndarray]:
        return {"level": self.level[:, None].copy()}

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        if ((self.steps == 3) & (self.level == self.faulty_level)).any():
            raise RuntimeError(f"broken at level {self.faulty_level}")
        return {"still": np.zeros(self.worlds)}

    def is_success(self) -> np.ndarray:
        return self.level <= 0.6


class ChoosingBatch(LevelledBatch):
    """Chooses half the level for the episode after one."""

    def next_levels(self) -> np.ndarray:
        return 0.5 * self.level
