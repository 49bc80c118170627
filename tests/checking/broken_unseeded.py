"""Robots that begin the same episode whenever reset gets no seed, and a twin that goes on with its generator."""

from broken_meaning import Drone
from mujoco_robots import MujocoArm
from robots import Boat, Pusher


class RL312BoatSeedsWithZero(Boat):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=0 if seed is None else seed, options=options)


class SeedsAgain:
    """Seeds itself with the last seed."""

    last = 0

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.last = seed
        return super().reset(seed=self.last, options=options)


class RL312DroneSeedsAgain(SeedsAgain, Drone): ...


class RL312ArmSeedsWithZero(MujocoArm):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=0 if seed is None else seed, options=options)


class RL312PusherSeedsAgain(SeedsAgain, Pusher): ...
