"""Small tasks whose numbers can be worked out by hand."""

from dataclasses import dataclass

import numpy as np

from rlctl.task import Box, Discrete, Event, Sim, Task, events


@dataclass
class Slider(Task):
    """A number moves by the action; what `fault` names goes wrong at the third step."""

    start: float = 1.0
    fault: str = ""

    control_dt, substeps, episode_s = 0.1, 2, 0.5
    action_space = Box(-1.0, 1.0, (2,), np.float32)
    action_meaning = "moves"
    observation_units = {"place": "m"}
    reward_weights = {"distance": -2.0, "effort": -0.5, "seen": 0.0}

    def build(self, sim: Sim) -> None:
        self.steps = 0

    def reset(self, rng):
        self.place, self.steps = self.start, 0

    def act(self, action):
        self.steps += 1
        self.action = action
        self.place += float(action[0])

    def failing(self, fault: str) -> bool:
        return self.fault == fault and self.steps == 3

    def observe(self):
        place = np.array([self.place])
        if self.failing("nan observation"):
            place[0] = np.nan
        if self.failing("shape"):
            place = np.zeros(3)
        return {"place": place, "counters": np.array([self.steps, 7.0])}

    def rewards(self, action):
        terms = {"seen": 4.0, "effort": abs(float(action[1])), "distance": abs(self.place)}
        if self.failing("one reward"):
            return 1.0
        if self.failing("nan term"):
            terms["effort"] = float("nan")
        if self.failing("missing term"):
            del terms["effort"]
        if self.failing("unknown term"):
            terms["efort"] = 1.0
        if self.failing("overflow"):
            terms["distance"] = 1e308
        return terms

    def is_success(self):
        return abs(self.place) < 0.1

    def is_terminated(self):
        return self.place > 2.0


class Plain(Slider):
    """No success, no termination."""

    def is_terminated(self):
        return False


Plain.is_success = Task.is_success


class ByName(Slider):
    """Observed as a dictionary."""

    observation_layout = "dict"


@dataclass
class Place(Task):
    """A point in a square is moved to a goal; 1 is lost at every step that ends away from it. No physics."""

    tolerance: float = 0.1

    control_dt, episode_s = 0.1, 1.0
    action_space = Box(-1.0, 1.0, (2,), np.float32)
    observation_layout = "dict"
    reward_weights = {"away": -1.0}

    def build(self, sim: Sim) -> None:
        self.place = self.goal = np.zeros(2)

    def reset(self, rng):
        self.place, self.goal = np.zeros(2), rng.uniform(-1, 1, 2)

    def act(self, action):
        self.place = np.clip(self.place + 0.1 * action, -1, 1)

    def observe(self):
        return {"observation": self.place, "achieved_goal": self.place, "desired_goal": self.goal}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -1.0 * (np.linalg.norm(achieved_goal - desired_goal, axis=-1) > self.tolerance)

    def rewards(self, action):
        return {"away": -float(self.compute_reward(self.place, self.goal, {}))}

    def is_success(self):
        return bool(np.linalg.norm(self.place - self.goal) <= self.tolerance)


class Buttons(Slider):
    """Two buttons."""

    action_space = Discrete(2)

    def act(self, action):
        super().act([0.1 * action, 0.0])

    def rewards(self, action):
        return super().rewards([0.0, 0.0])


class Bounded(Slider):
    observation_bounds = {"place": (-1.0, 1.5)}


class Cart(Task):
    """A cube on a plane, with events."""

    control_dt, substeps, episode_s = 1 / 60, 4, 1.0
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"height": 1.0}
    events = {
        "mass": Event("reset", events.scale_mass, body="cube", factor=(0.5, 2.0)),
        "friction": Event("interval", events.set_friction, every_s=0.25, body="plane", friction=(0.1, 0.9)),
    }

    def build(self, sim: Sim) -> None:
        self.plane = sim.load("plane", "plane.urdf", fixed=True)
        self.cube = sim.load("cube", "cube_small.urdf", position=(0.0, 0.0, 0.1), inertia="shape")

    def reset(self, rng):
        self.cube.set_base((0.0, 0.0, 0.1 + 0.1 * rng.random()))

    def act(self, action):
        pass

    def observe(self):
        return {"cube": self.cube.base_position}

    def rewards(self, action):
        return {"height": float(self.cube.base_position[2])}


class Pile(Task):
    """Twelve free cubes, balls and ducks fall on one another."""

    pieces_count, models = 12, ("cube_small.urdf", "sphere_small.urdf", "duck_vhacd.urdf")
    control_dt, substeps, episode_s = 1 / 60, 4, 4.0
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"height": 1.0}

    def build(self, sim: Sim) -> None:
        sim.load("plane", "plane.urdf", fixed=True)
        files = [self.models[i % len(self.models)] for i in range(self.pieces_count)]
        self.pieces = [
            sim.load(f"piece{i}", file, position=(0.0, 0.0, 0.2 * i), inertia="shape")
            for i, file in enumerate(files, 1)
        ]

    def reset(self, rng):
        for i, piece in enumerate(self.pieces):
            piece.set_base((*rng.uniform(-0.02, 0.02, 2), 0.05 + 0.055 * i))

    def act(self, action):
        pass

    def observe(self):
        return {piece.name: np.r_[piece.base_position, piece.base_orientation] for piece in self.pieces}

    def rewards(self, action):
        return {"height": 0.0}


class Stadium(Slider):
    """The same on a ground of `pybullet_data`, an SDF file, which MuJoCo does not read."""

    def build(self, sim: Sim) -> None:
        super().build(sim)
        sim.load("ground", "plane_stadium.sdf")


class Cubes(Pile):
    """Five cubes only."""

    pieces_count, models = 5, ("cube_small.urdf",)


class PileAnew(Pile):
    """The same, loaded anew at every reset."""

    fast_reset = False
