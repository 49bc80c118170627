"""Tasks and plain environments to replay."""

from dataclasses import dataclass

import gymnasium
import numpy as np
from gymnasium import spaces

from rlctl.task import Box, Event, Sim, Task, events, rough_heights


@dataclass
class Tumble(Task):
    """A cube falls beside a car; the goal moves, and the cube's mass is drawn."""

    car: str = "racecar/racecar.urdf"

    control_dt, substeps, episode_s = 1 / 60, 4, 0.5
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"height": -2.0, "metric": 0.0}
    events = {
        "mass": Event("reset", events.scale_mass, body="cube", factor=(0.5, 2.0), enabled=True),
        "grip": Event("interval", events.set_friction, every_s=0.25, body="cube", friction=(0.1, 1.0), enabled=True),
    }

    def build(self, sim: Sim) -> None:
        sim.load("ground", "plane.urdf", fixed=True)
        self.cube = sim.load("cube", "cube_small.urdf", position=(0.5, 0.2, 0.4), inertia="shape")
        sim.load("car", self.car, position=(-0.5, 0.0, 0.1))

    def reset(self, rng: np.random.Generator) -> None:
        self.time = 0.0
        self.cube.set_base((0.5, rng.uniform(-0.2, 0.2), 0.4), (0.0, 0.0, 0.6, 0.8))

    def act(self, action: np.ndarray) -> None:
        self.time += self.control_dt

    def observe(self) -> dict[str, np.ndarray]:
        return {"position": self.cube.base_position, "time": np.array([self.time])}

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        return {"height": float(self.cube.base_position[2]), "metric": 1.0}

    def is_success(self) -> bool:
        return 0.1 < self.cube.base_position[2] < 0.3

    def markers(self) -> dict[str, np.ndarray]:
        return {"goal": np.array([self.time, 0.0, 0.2])}


@dataclass
class Rough(Tumble):
    """The same on rough ground."""

    def build(self, sim: Sim) -> None:
        super().build(sim)
        self.heights = rough_heights(0, size=(4, 3), cell=0.5, roughness=0.1)
        sim.add_height_field("hills", self.heights, cell=0.5)


class Pixels(gymnasium.Env):
    """Discrete actions, a dictionary to observe, and a picture that is drawn."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, render_mode: str | None = None, fault: str = "", steps: int = 10):
        self.render_mode = render_mode
        self.fault = fault
        self.length = steps
        self.action_space = spaces.Discrete(3)
        self.observation_space = spaces.Dict(
            {
                "count": spaces.Discrete(1000),
                "point": spaces.Box(-1.0, 1.0, (2,), np.float32),
                "eye": spaces.Box(0, 255, (12, 16, 3), np.uint8),
            }
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.point = 0, self.np_random.uniform(-1, 1, 2)
        return self._observation(), {}

    def _observation(self):
        eye = np.full((12, 16, 3), 20 * self.steps % 256, np.uint8)
        return {"count": self.steps, "point": self.point.astype(np.float32), "eye": eye}

    def step(self, action):
        self.steps += 1
        if self.fault == "talk":
            print("a plugin talks")
        if self.fault == "step" and self.steps == 4:
            raise RuntimeError("lost a wheel")
        return self._observation(), float(action), False, self.steps >= self.length, {}

    def render(self):
        if self.fault == "render":
            raise OSError("no OpenGL")
        return np.full((40, 60, 3), 20 * self.steps % 256, np.uint8)


class Kitchen(Pixels):
    """Observes a Dict inside a Dict, as FrankaKitchen of gymnasium-robotics does."""

    def __init__(self, render_mode: str | None = None):
        super().__init__(render_mode)
        goals = spaces.Dict({name: spaces.Box(-2.0, 2.0, (size,), np.float64) for name, size in _GOALS.items()})
        self.observation_space = spaces.Dict(
            {"observation": spaces.Box(-1.0, 1.0, (2,), np.float64), "achieved_goal": goals}
        )

    def _observation(self):
        goals = {name: np.full(size, 0.1 * self.steps) for name, size in _GOALS.items()}
        return {"observation": self.point, "achieved_goal": goals}


_GOALS = {"kettle": 3, "microwave": 1}


class Blind(Pixels):
    """Cannot draw at all; its constructor knows no render_mode."""

    def __init__(self):
        super().__init__()


class Undrawn(Pixels):
    """Takes a render_mode, and has no render()."""

    render = gymnasium.Env.render


class Chance(Pixels):
    """Not reproducible: after five steps its point comes from nowhere."""

    def step(self, action):
        if self.steps >= 5:
            self.point = np.random.default_rng().uniform(-1, 1, 2)
        return super().step(action)
