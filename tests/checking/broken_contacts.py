"""Robots that count any contact as a bump, next to their twins, which ask for the pair that is meant."""

import numpy as np
import pybullet as p
from broken_turned import CART, FLYER, Cart, Flyer, Puck
from broken_units import ArmWithBall, Noise
from robots import Crawler, Pusher

CRATE = """<geom name="floor" type="plane" size="9 9 1"/><body name="crate" pos="2 2 .2"><freejoint/>
<geom name="crate" type="box" size=".2 .2 .2" mass="5"/></body></worldbody>"""


class PusherTouches(Pusher):
    """It sees whether its crank touches the cube, which is too far away for most actions."""

    rlctl_ignore = {**Pusher.rlctl_ignore, "RL110": "a consequence", "RL611": "chance does not push the cube so far"}
    placed = (0.4, 0.3, 0.03)

    def size(self):
        return super().size() + 1

    def info(self, success):
        return {"is_success": p.getBasePositionAndOrientation(self.cube, physicsClientId=self.client)[0][1] > 0.35}

    def contacts(self):
        return p.getContactPoints(self.robot, self.cube, physicsClientId=self.client)

    def observe(self):
        return np.append(super().observe(), np.float32(len(self.contacts()) > 0))


class RL825PusherCubeTouchesAnything(PusherTouches):
    def contacts(self):
        return p.getContactPoints(bodyA=self.cube, physicsClientId=self.client)


class RL825PusherAnything(PusherTouches):
    def contacts(self):
        return p.getContactPoints(physicsClientId=self.client)


class RL825PusherAnythingWithNoise(Noise, RL825PusherAnything): ...


class CrawlerBumps(Crawler):
    """It pays for what its trunk touches."""

    def has_bumped(self):
        return len(p.getContactPoints(self.robot, linkIndexA=-1, physicsClientId=self.client)) > 0

    def reward(self):
        return super().reward() - 0.3 * self.has_bumped()


class RL825CrawlerStands(CrawlerBumps):
    def has_bumped(self):
        return len(p.getContactPoints(self.robot, physicsClientId=self.client)) > 0


class CrawlerFeet(Crawler):
    """It sees which of its feet stand on anything, as nearly always both do."""

    def size(self):
        return super().size() + 2

    def observe(self):
        feet = [p.getContactPoints(self.robot, linkIndexA=i, physicsClientId=self.client) for i in range(2)]
        return np.append(super().observe(), [float(len(contacts) > 0) for contacts in feet]).astype(np.float32)


class PuckWithWall(Puck):
    """It ends where it bumps into a wall."""

    def __init__(self):
        super().__init__()
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1, 1.0, 0.5], physicsClientId=self.client)
        self.wall = p.createMultiBody(0, shape, basePosition=[2, 0, 0.5], physicsClientId=self.client)
        self.state = p.saveState(physicsClientId=self.client)

    def has_failed(self):
        return len(p.getContactPoints(self.robot, self.wall, physicsClientId=self.client)) > 0


class RL825PuckEndsOnTheGround(PuckWithWall):
    rlctl_ignore = {
        **PuckWithWall.rlctl_ignore,
        "RL302": "contacts are not reset, and each episode is their first step",
        "RL504": "a consequence",
    }

    def has_failed(self):
        return len(p.getContactPoints(self.robot, physicsClientId=self.client)) > 0


class Bumps:
    """It pays for bumps, and says so."""

    def reward(self):
        return super().reward() - 0.5 * self.has_bumped()

    def pairs(self):
        geoms = [(contact.geom1, contact.geom2) for contact in self.data.contact]
        return [tuple(self.model.geom(geom).name for geom in pair) for pair in geoms]


class ArmBumps(Bumps, ArmWithBall):
    """Where it touches its ball or the table."""

    def has_bumped(self):
        mine = ("upper_arm", "lower_arm", "palm", "finger")
        return any(one in mine or two in mine for one, two in self.pairs())


class RL825ArmAnything(ArmBumps):
    def has_bumped(self):
        return self.data.ncon > 0


class CartBumps(Bumps, Cart):
    """Where its body touches anything."""

    rlctl_ignore = {"RL306": "it does not see its heading"}

    xml = CART.replace('<geom type="box"', '<geom name="trunk" type="box"')

    def has_bumped(self):
        return any("trunk" in pair for pair in self.pairs())


class RL825CartStands(CartBumps):
    def has_bumped(self):
        return len(self.data.contact) > 0


class FlyerBumps(Bumps, Flyer):
    """Where it touches the crate or the floor; the crate is far away on the floor."""

    rlctl_ignore = {"RL306": "it does not see its heading", "RL110": "it never tilts"}

    xml = FLYER.replace("</worldbody>", CRATE).replace('<geom type="box"', '<geom name="hull" type="box"')

    def has_bumped(self):
        return any("hull" in pair for pair in self.pairs())


class RL825FlyerAnything(FlyerBumps):
    def observe(self):
        return np.append(super().observe(), float(self.data.ncon > 0))
