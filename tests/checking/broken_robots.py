"""Robots with one mistake each, next to the twin that does the same thing right where the robot itself does not."""

import numpy as np
import pybullet as p
from robots import Arm, Boat, Crawler, Pusher, Tank


class RL114BoatHiddenBuoy(Boat):
    def observe(self):
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.array([*self.place, s, c, *self.speed], np.float32)


class RL114TankHiddenWish(Tank):
    def size(self):
        return 2

    def observe(self):
        return np.array([self.temperature, self.rate], np.float32)


class RL115BoatOldObservation(Boat):
    def step(self, action):
        observation = self.observe()
        _, *rest = super().step(action)
        return observation, *rest


class RL115ArmOldObservation(Arm):
    rlctl_ignore = {"RL815": "the engine shows it as well"}

    def move(self, action):
        self.before = super().observe()
        super().move(action)

    def observe(self):
        return super().observe() if self.steps == 0 else self.before


class RL116CrawlerQuaternion(Crawler):
    def angles(self):
        _, (x, y, z, w) = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        return p.getEulerFromQuaternion((w, x, y, z))


class RL116ArmQuaternion(Arm):
    def size(self):
        return 9

    def angles(self):
        w, x, y, z = self.hand()[5]
        return p.getEulerFromQuaternion((x, y, z, w))

    def observe(self):
        return np.array([*super().observe(), *self.angles()], np.float32)


class RL116ArmRightQuaternion(RL116ArmQuaternion):
    def angles(self):
        return p.getEulerFromQuaternion(self.hand()[5])


class RL117BoatWraps(Boat):
    def observe(self):
        heading = (self.heading + np.pi) % (2 * np.pi) - np.pi
        return np.array([*(self.buoy - self.place), heading, 0.1 * heading**2, *self.speed], np.float32)


class RL117CrawlerWraps(Crawler):
    rlctl_ignore = {
        "RL303": "contacts are not reset to the last bit",
        "RL123": "it observes no heading",
    }

    def angles(self):
        self.turn = 0.0 if self.steps == 0 else self.turn + 0.3
        return [*super().angles()[:2], np.arctan2(np.sin(self.turn), np.cos(self.turn))]


class RL118BoatMillimetres(Boat):
    def observe(self):
        observation = super().observe()
        observation[:2] *= 1000  # [mm]
        return observation


class RL118CrawlerDegrees(Crawler):
    def observe(self):
        return np.rad2deg(super().observe() + 2.0).astype(np.float32)


class RL310BoatStaysAtBuoy(Boat):
    arrived = False

    def is_success(self):
        self.arrived = self.arrived or self.distance() < 0.2
        return self.distance() < (0.24 if self.arrived else 0.2)


class RL310BoatArrives(RL310BoatStaysAtBuoy):
    def start(self):
        super().start()
        self.arrived = False


class RL310TankCountsOn(Tank):
    failures = 0

    def has_failed(self):
        failed = super().has_failed()
        self.failures += failed
        return failed

    def reward(self):
        return super().reward() - 0.5 * self.failures


class RL310TankCountsAnew(RL310TankCountsOn):
    def start(self):
        super().start()
        self.failures = 0


class RL311BoatGusts(Boat):
    def __init__(self):
        super().__init__()
        self.gusts = np.random.default_rng()

    def move(self, action):
        if self.distance() > 2.0:
            self.speed[0] += self.gusts.normal(0.0, 0.1)
        super().move(action)


class RL311BoatSeededGusts(RL311BoatGusts):
    def start(self):
        super().start()
        self.gusts = self.np_random


class RL311TankSpills(Tank):
    def move(self, action):
        if self.temperature > 0.8:
            self.temperature -= np.random.default_rng().uniform(0.0, 0.1)
        super().move(action)


class RL311TankSeededSpills(Tank):
    def move(self, action):
        if self.temperature > 0.8:
            self.temperature -= self.np_random.uniform(0.0, 0.1)
        super().move(action)


class RL507TankFailsAsTruncated(Tank):
    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, False, terminated or truncated, info


class RL507CrawlerFallsAsTruncated(Crawler):
    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        fell = abs(self.angles()[1]) > 0.06
        return observation, reward, False, bool(truncated or fell), info


class RL507CrawlerFalls(Crawler):
    def has_failed(self):
        return bool(abs(self.angles()[1]) > 0.06)


class RL607BoatTermsOff(Boat):
    def info(self, success):
        terms = {"distance": -self.distance(), "speed": 0.1 * self.speed[0]}
        return {"is_success": success, "reward_terms": terms}


class RL607BoatTerms(Boat):
    def info(self, success):
        terms = {"distance": -self.distance(), "arrival": 2.0 * success}
        return {"is_success": success, "reward_terms": terms}


class RL607CrawlerTermsOff(Crawler):
    def info(self, success):
        return {**super().info(success), "reward_terms": {"forward": max(self.forward(), 0.0)}}


class RL607CrawlerRawTerms(Crawler):
    def info(self, success):
        return {**super().info(success), "reward_terms": {"forward": 0.5 * self.forward()}}


class RL607CrawlerTerms(Crawler):
    def info(self, success):
        return {**super().info(success), "reward_terms": {"forward": self.forward()}}


class RL615BoatMovingBuoy(Boat):
    def observe(self):
        return np.array([*self.place, np.sin(self.heading), np.cos(self.heading), *self.speed], np.float32)

    def start(self):
        super().start()
        self.heading = 0.0

    def move(self, action):
        super().move(action)
        if self.steps % 20 == 0:
            self.buoy = self.draw_buoy()


class RL615BoatFixedBuoy(RL615BoatMovingBuoy):
    def draw_buoy(self):
        return np.array([0.5, 0.5])


class RL615TankOneWish(Tank):
    def start(self):
        self.temperature, self.rate, self.wanted = 0.0, 0.0, 0.5
        self.power = self.np_random.uniform(0.5, 1.0)

    def observe(self):
        return np.array([self.temperature, self.rate, self.power], np.float32)

    def move(self, action):
        super().move(self.power * action)


class RL615TankOtherWish(RL615TankOneWish):
    def move(self, action):
        super().move(action)
        if self.steps == 30:
            self.wanted = 0.2


class RL616BoatLateReward(Boat):
    def step(self, action):
        reward = self.reward()
        observation, _, *rest = super().step(action)
        return observation, reward, *rest


class RL616ArmLateReward(Arm):
    def step(self, action):
        height = self.hand()[4][2]
        observation, _, *rest = super().step(action)
        return observation, height - 0.8, *rest


class RL704BoatNan(Boat):
    def step(self, action):
        self.steps += 1
        self.move(np.clip(action, -1.0, 1.0).astype(float))
        return self.observe(), self.reward(), False, self.steps >= self.limit, {"is_success": self.is_success()}


class RL704TankNan(Tank):
    def step(self, action):
        self.steps += 1
        self.move(np.clip(action, -1.0, 1.0).astype(float))
        return self.observe(), self.reward(), False, self.steps >= self.limit, self.info(False)


class RL810ArmDegrees(Arm):
    def start(self):
        super().start()
        self.drive(np.rad2deg(self.home))


class RL810CrawlerStartsInDegrees(Crawler):
    def start(self):
        p.resetJointState(self.robot, 0, np.rad2deg(0.3), physicsClientId=self.client)
        super().start()


class RL811ArmOrder(Arm):
    home = np.array([0.9, -0.5, 0.3])

    def target(self, action):
        return super().target(action)[[1, 2, 0]]


class RL811CrawlerOrder(Crawler):
    def target(self, action):
        wrist, *others = super().target(action)
        return [*others, wrist]


class RL812ArmTouchesNothing(Arm):
    home = np.array([1.0, 1.1, 0.0])
    height = 0.2

    def reward(self):
        return super().reward() - 1.0 * self.touches(3)


class RL812ArmTouches(RL812ArmTouchesNothing):
    def reward(self):
        return Arm.reward(self) - 1.0 * self.touches(2)


class RL812ArmTouchesWithALinkThatItLacks(RL812ArmTouchesNothing):
    def reward(self):
        return Arm.reward(self) - 1.0 * self.touches(7)


class RL812CrawlerOtherFloor(Crawler):
    def touches(self, link):
        floor = self.robot + 1
        return len(p.getContactPoints(self.robot, floor, link, -1, physicsClientId=self.client) or ()) > 0

    def reward(self):
        return super().reward() + 0.1 * self.touches(0)


class RL812CrawlerFloor(Crawler):
    def reward(self):
        return super().reward() + 0.1 * self.touches(0)


class RL813ArmLongPhysicsSteps(Arm):
    def __init__(self):
        super().__init__()
        p.setTimeStep(1 / 30, physicsClientId=self.client)


class RL814ArmWeakMotors(Arm):
    def drive(self, targets):
        p.setJointMotorControlArray(
            self.robot, range(3), p.POSITION_CONTROL, list(targets), forces=[0.9] * 3, physicsClientId=self.client
        )


class RL815ArmOldHand(Arm):
    def hand(self):
        return p.getLinkState(self.robot, 3, physicsClientId=self.client)


class RL815PusherOldCube(Pusher):
    """How fast the cube is is read before the step."""

    def put_cube(self, place):
        super().put_cube(place)
        self.slides = np.zeros(3)

    def move(self, action):
        self.slides = np.array(p.getBaseVelocity(self.cube, physicsClientId=self.client)[0])
        super().move(action)

    def observe(self):
        return np.concatenate([super().observe()[:-3], self.slides]).astype(np.float32)


class RL815CrawlerOldFoot(Crawler):
    def reward(self):
        return super().reward() - p.getLinkState(self.robot, 0, physicsClientId=self.client)[4][2]


class RL815CrawlerFoot(Crawler):
    def reward(self):
        foot = p.getLinkState(self.robot, 0, computeForwardKinematics=True, physicsClientId=self.client)
        return super().reward() - foot[4][2]


class RL701ArmPullsOnly(Arm):
    def target(self, action):
        return super().target(np.array([max(0.0, action[0]), *action[1:]]))


class ArmPullsWithOneMotor(Arm):
    """It has the same range for all joints, and one of them moves in one direction only."""

    pulls, pushes = [0], []

    def target(self, action):
        way = np.array(action, float)
        way[self.pulls] = (way * (np.abs(way) + way))[self.pulls] / 2
        way[self.pushes] = (way * (np.abs(way) - way))[self.pushes] / 2
        return super().target(way)


class ArmPullsAndPushes(ArmPullsWithOneMotor):
    pushes = [1]


class RL701BoatForwardOnly(Boat):
    def move(self, action):
        super().move(np.maximum(action, 0.0))


class RL803PusherInsideItsCube(Pusher):
    rlctl_ignore = {**Pusher.rlctl_ignore, "RL302": "a consequence"}

    def put_cube(self, place):
        super().put_cube(place)
        if self.np_random.random() < 0.5:
            place = [0.26, 0.035, 0.03]
            p.resetBasePositionAndOrientation(self.cube, place, [0, 0, 0, 1], physicsClientId=self.client)


class TorqueDriven:
    """Its actions are torques of its joints."""

    def move(self, action):
        for _ in range(4):
            torques = (self.torque * action).tolist()
            p.setJointMotorControlArray(
                self.robot, range(3), p.TORQUE_CONTROL, forces=torques, physicsClientId=self.client
            )
            p.stepSimulation(physicsClientId=self.client)

    def drive(self, targets):
        """Leave the joints where reset has put them."""

    def release(self):
        for joint in range(3):
            p.setJointMotorControl2(self.robot, joint, p.VELOCITY_CONTROL, force=0, physicsClientId=self.client)


class ArmHeldByMotors(TorqueDriven, Arm):
    torque = 3.0  # [N m]


class ArmDriven(ArmHeldByMotors):
    def load(self):
        super().load()
        self.release()


class RL821CrawlerHeldByMotors(TorqueDriven, Crawler):
    rlctl_ignore = {"RL303": "contacts are not reset to the last bit", "RL706": "a consequence"}
    torque = 0.5  # [N m]


class RL821CrawlerDriven(RL821CrawlerHeldByMotors):
    def load(self):
        super().load()
        self.release()


class Increments:
    """Each action changes the targets of the joints, which are kept and stay within the limits."""

    most = 1.0

    def start(self):
        self.targets = np.array(self.home)
        super().start()

    def target(self, action):
        infos = [p.getJointInfo(self.robot, joint, physicsClientId=self.client) for joint in range(3)]
        low, high = np.array([info[8:10] for info in infos]).T
        self.targets = np.clip(self.targets + 0.3 * action, self.most * low, self.most * high)
        return self.targets


class TooFar(Increments):
    most = 1e3


class ArmIncrements(Increments, Arm): ...


class ArmIncrementsTooFar(TooFar, Arm): ...


class CrawlerIncrements(Increments, Crawler): ...


class CrawlerIncrementsTooFar(TooFar, Crawler): ...


class PusherIncrements(Increments, Pusher): ...


class PusherIncrementsTooFar(TooFar, Pusher): ...


class ArmKeepsJoints(Arm):
    """Continues where it is after a reset."""

    def start(self):
        self.drive(self.home)


class CrawlerKeepsBase(Crawler):
    """Sets its joints at reset, and leaves its base where it is."""

    def size(self):
        return super().size() + 3

    def start(self):
        for joint, position in enumerate(self.home):
            p.resetJointState(self.robot, joint, position, physicsClientId=self.client)

    def observe(self):
        velocity, _ = p.getBaseVelocity(self.robot, physicsClientId=self.client)
        return np.concatenate([super().observe(), velocity]).astype(np.float32)
