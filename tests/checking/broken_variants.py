"""Tasks that work as they are, and do not when a recipe switches their events on, or goes through their stages."""

from dataclasses import dataclass

import numpy as np

from rlctl.task import Event, events
from rlctl_manipulation.reach import Reach

RANDOM = np.random.default_rng()


def shift_home(sim, rng):
    """Draw from a generator of its own."""
    arm = sim.body("arm")
    by = float(RANDOM.uniform(-0.1, 0.1))
    arm.set_joints(arm.joint_positions + by)
    return {"by": by}


def break_down(sim, rng):
    """Raise when half a second has passed."""
    if RANDOM is not None and sim.body("arm").joint_velocities.any():
        raise RuntimeError("a gear broke")
    return {}


@dataclass
class NotFinite(Reach):
    def rewards(self, action):
        return {**super().rewards(action), "distance": float("nan")}


@dataclass
class Sound(Reach):
    stages = [
        {"task": {"tolerance": 0.2}, "promote": {"success": 0.8}},
        {"events": {"mass": {"factor": [0.9, 1.1]}}},
    ]


@dataclass
class RL013Misspelled(Reach):
    """Two names that have no effect, and one that is close to such a name and is used."""

    episode_seconds = 2.0
    marker = "hand"

    def is_terminate(self):
        return self.marker == "foot"


@dataclass
class RL011WrongBody(Reach):
    events = {"mass": Event("reset", events.scale_mass, body="amr", factor=(0.8, 1.2))}


@dataclass
class RL011OwnChance(Reach):
    events = {"home": Event("start", shift_home)}


@dataclass
class RL011BreaksDown(Reach):
    events = {"gear": Event("interval", break_down, every_s=0.5)}


@dataclass
class RL011NeedsItsEvents(Reach):
    """What is on by itself is off in nothing that can be trained; nothing is wrong with it."""

    events = {"mass": Event("reset", events.scale_mass, body="arm", factor=(0.8, 1.2), enabled=True)}


def forget_mass(sim, rng, *, factor: events.Range):
    """Draw, and change nothing."""
    drawn = float(rng.uniform(*factor))
    sim.body("arm").scale_mass(1.0)
    return {"factor": drawn}


def apply_mass(sim, rng, *, factor: events.Range):
    """Draw and change."""
    drawn = float(rng.uniform(*factor))
    sim.body("arm").scale_mass(drawn)
    return {"factor": drawn}


@dataclass
class RL014ForgetsTheMass(Reach):
    events = {"payload": Event("reset", forget_mass, factor=(0.8, 1.2))}


@dataclass
class RL014AppliesTheMass(RL014ForgetsTheMass):
    events = {"payload": Event("reset", apply_mass, factor=(0.8, 1.2))}


@dataclass
class RL012WrongKey(Reach):
    stages = [{"taks": {"tolerance": 0.2}, "promote": {"success": 0.8}}, {}]


@dataclass
class RL012WrongParameter(Reach):
    stages = [{"task": {"tolerence": 0.2}, "promote": {"success": 0.8}}, {}]


@dataclass
class RL012WrongEvent(Reach):
    stages = [{"promote": {"success": 0.8}}, {"events": {"masss": {"factor": [1, 2]}}}]


@dataclass
class RL012OtherSpaces(Reach):
    see_goal: bool = True

    observation_units = {}
    stages = [{"task": {"see_goal": False}, "promote": {"success": 0.8}}, {}]

    def observe(self):
        parts = super().observe()
        return parts if self.see_goal else {name: parts[name] for name in ("joint_positions", "hand_to_goal")}


@dataclass
class RL014ActsInTime(Reach):
    """Its event acts twice in an episode; nothing is wrong with it."""

    events = {"gust": Event("interval", events.push, every_s=1.0, body="arm", link="lbr_iiwa_link_6", force=(0.0, 1.0))}


@dataclass
class RL014PushesTheStand(Reach):
    """Without a link it is the base that is pushed, which is fixed."""

    events = {"gust": Event("interval", events.push, every_s=1.0, body="arm", force=(0.0, 1.0))}


@dataclass
class RL014WeighsTheStand(Reach):
    events = {"load": Event("reset", events.scale_mass, body="arm", links=["lbr_iiwa_link_0"], factor=(0.5, 2.0))}


@dataclass
class RL014ActsTooLate(Reach):
    events = {
        "gust": Event("interval", events.push, every_s=30.0, body="arm", link="lbr_iiwa_link_6", force=(0.0, 1.0))
    }
