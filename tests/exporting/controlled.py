"""A task whose observation is computed from measured quantities, for controllers."""

from dataclasses import dataclass

import numpy as np

from rlctl.task import Box, Event, Joints, Sim, Task, events, terms


@dataclass
class Cart(Task):
    """Two carts move by steps towards a goal; what `fault` names is not as it is declared."""

    fault: str = ""

    control_dt, substeps, episode_s = 0.1, 1, 12.0
    action_space = Box(-1.0, 1.0, (2,), np.float32)
    observation_units = {"places": "m", "goal": "m"}
    observation_terms = {"to_goal": terms.Displacement("goal", "places"), "last_action": terms.LastAction()}
    observation_history = {"places": 3}
    reward_weights = {"distance": -1.0}
    events = {"noise": Event("observation", events.noise, of="to_goal", std=(0.1, 0.2))}

    def build(self, sim: Sim) -> None:
        pass

    def reset(self, rng):
        self.places, self.goal, self.last = rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2), np.zeros(2)

    def act(self, action):
        self.places, self.last = np.clip(self.places + 0.05 * action, -2.0, 2.0), action.astype(float)

    def observe(self):
        last = 0.5 * self.last if self.fault == "last action" else self.last
        return {"places": self.places, "to_goal": (self.goal, self.places), "last_action": last}

    def rewards(self, action):
        return {"distance": float(np.linalg.norm(self.goal - self.places))}

    def is_success(self):
        return bool(np.linalg.norm(self.goal - self.places) < 0.1)

    def describe_joints(self):
        ends = {"low": [-2.0, -2.0], "high": [2.0, 2.0]}
        return Joints(["left", "right"], action_step=[0.05, 0.05], measured="places", clips_target=True, **ends)
