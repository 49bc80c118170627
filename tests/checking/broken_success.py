"""Boats whose success is true elsewhere, or whose reward pays a cost or throws a part away, next to twins."""

import math

import numpy as np
from broken_unwrapped import BoatShowsItsError, wrap
from robots import Boat


class BoatMoors(BoatShowsItsError):
    """It lies at its buoy where it is near to it, and points to it."""

    def is_success(self):
        return bool(self.distance() < 0.2 and abs(self.error()) < 0.3)


class RL646BoatMoorsToOneSide(BoatMoors):
    rlctl_ignore = {"RL605": "it is paid for lying there as well", "RL117": "it jumps there"}

    def is_success(self):
        return bool(self.distance() < 0.2 and self.error() < 0.3)


class BoatMoorsAnyhow(BoatMoors):
    def is_success(self):
        is_near, is_straight = self.distance() < 0.2, abs(self.error()) < 0.3
        return bool(is_near or is_straight)


class BoatMoorsAtEitherEnd(BoatMoors):
    """Its bow or its stern is at the buoy."""

    def is_success(self):
        bow = np.array([math.cos(self.heading), math.sin(self.heading)])
        ends = [np.linalg.norm(self.buoy - self.place - part * bow) for part in (0.3, -0.3)]
        return bool(ends[0] < 0.1 or ends[1] < 0.1)


class BoatMoorsFully(BoatMoors):
    """Both of its errors are small, for some steps."""

    def start(self):
        super().start()
        self.lasting = 0

    def is_success(self):
        errors = np.abs([self.distance(), wrap(self.bearing() - self.heading)])
        self.lasting = self.lasting + 1 if self.fits(errors) else 0
        return self.lasting >= 2

    def fits(self, errors):
        return (errors < 0.2).all()

    def reward(self):
        errors = np.abs([self.distance(), wrap(self.bearing() - self.heading)])
        return -np.sum(errors)


class BoatMoorsWithOneOfThem(BoatMoorsFully):
    def fits(self, errors):
        return (errors < 0.2).any()


class BoatMoorsByTheSmallerOne(BoatMoorsFully):
    def fits(self, errors):
        return errors.min() < 0.2


class BoatTurnsSlowly(Boat):
    """It is paid for being near its buoy, and pays for turning."""

    def start(self):
        super().start()
        self.visits = self.last_visits = 0
        self.turns = self.last_turns = False

    def move(self, action):
        self.taken = action
        super().move(action)
        self.visits += self.distance() < 0.05

    def reward(self):
        reward = -0.1 * self.speed[1] ** 2
        reward -= self.distance()
        return reward


class RL647BoatForgetsItsTurns(BoatTurnsSlowly):
    def reward(self):
        reward = -0.1 * self.speed[1] ** 2
        reward = -self.distance()
        return float(reward)


class BoatChargesForTurns(BoatTurnsSlowly):
    def reward(self):
        distance_cost = self.distance()
        turning_cost = 0.1 * self.speed[1] ** 2
        return -(distance_cost + turning_cost)


class BoatForgetsToCharge(BoatTurnsSlowly):
    def reward(self):
        distance_cost = self.distance()
        turning_cost = 0.1 * self.speed[1] ** 2  # noqa: F841
        return -distance_cost


class BoatTellsOfItsTurns(BoatTurnsSlowly):
    """What it pays for its turns is not in its reward, and read."""

    def reward(self):
        distance_cost = self.distance()
        turning_cost = 0.1 * self.speed[1] ** 2
        lost_bonus = 0.0  # noqa: F841
        self.told = f"{turning_cost:.3f}"
        return -distance_cost


class BoatOwesUntilItIsNear(BoatTurnsSlowly):
    def reward(self):
        return min(0.0, 0.05 - 0.3 * self.distance())


class BoatAlwaysOwes(BoatTurnsSlowly):
    """Its rewards are small beside its costs, and clipped."""

    def reward(self):
        earned = 1.0 - 0.3 * self.distance()
        return max(0.0, earned - 20.0 * abs(self.heading - 9.0))


class BoatKeepsToItsLane(BoatTurnsSlowly):
    """It pays for what is beyond its lane, to either side."""

    def reward(self):
        return -self.distance() - self.lane_penalty(self.place[1])

    def lane_penalty(self, offset):
        penalty = 0.0
        if offset > 0.2:
            penalty += (offset - 0.2) * 0.5
        elif offset < -0.2:
            penalty += (-0.2 - offset) * 0.5
        return penalty


class BoatSpares(BoatTurnsSlowly):
    def reward(self):
        effort = np.sum(np.square(self.taken))
        return -self.distance() - 0.05 * effort


class BoatSpends(BoatSpares):
    def reward(self):
        effort = -np.sum(np.square(self.taken))
        return -self.distance() - 0.05 * effort


class BoatIsPaidForItsRest(BoatSpares):
    """What it has not spent is paid."""

    def reward(self):
        effort = np.sum(np.square(self.taken)) / 2
        return -self.distance() + 0.05 * (1 - effort) ** 2


class BoatStopsPaying(BoatTurnsSlowly):
    """Nothing is paid for its speed where it is lost."""

    def reward(self):
        lost = bool(self.distance() > 3.0)
        return -self.distance() + (0.0 if lost else 0.1 * self.speed[0])


class BoatIsPaidForBeingLost(BoatTurnsSlowly):
    def reward(self):
        lost = bool(self.distance() > 3.0)
        return -self.distance() + (5.0 if lost else 0.1 * self.speed[0])


class BoatLimitsItsTurns(BoatTurnsSlowly):
    def reward(self):
        return -self.distance() - 0.1 * abs(np.clip(self.speed[1], -0.5, 0.5))


class BoatLimitsItsTurnsTheWrongWay(BoatLimitsItsTurns):
    def reward(self):
        return -self.distance() - 0.1 * abs(np.clip(self.speed[1], 0.5, -0.5))


class BoatCountsVisits(BoatTurnsSlowly):
    def reward(self):
        gained = self.visits - self.last_visits
        self.last_visits = self.visits
        return gained - self.distance()


class BoatCountsNoVisits(BoatCountsVisits):
    def reward(self):
        self.last_visits = self.visits
        gained = self.visits - self.last_visits
        return gained - self.distance()


class BoatTurnsOn(BoatTurnsSlowly):
    """It is paid for turning on to the same side."""

    def reward(self):
        turns = self.speed[1] > 0
        reward = 0.1 * (turns & self.last_turns) - self.distance()
        self.last_turns = turns
        return reward


class BoatTurnsOnSinceTheStart(BoatTurnsOn):
    def reward(self):
        turns = self.speed[1] > 0
        return 0.1 * (turns ^ self.last_turns) - self.distance()


class BoatTurnsFromItself(BoatTurnsSlowly):
    def reward(self):
        return -self.distance() - 0.1 * (self.speed[1] - self.speed[1]) ** 2


class BoatKeepsCourse(BoatShowsItsError):
    def reward(self):
        return 0.2 * np.exp(-(self.error() ** 2)) - self.distance()


class BoatLeavesItsCourse(BoatKeepsCourse):
    def reward(self):
        return 0.2 * np.exp((-self.error()) ** 2) - self.distance()


class BoatFetchesItsCrate(Boat):
    """It goes to a crate, which it then takes to a goal."""

    def start(self):
        super().start()
        self.goal = self.buoy
        self.crate = self.place + self.np_random.uniform(-0.3, 0.3, 2)

    def size(self):
        return 8

    def observe(self):
        return np.array([*super().observe(), *(self.goal - self.crate)], np.float32)

    def move(self, action):
        before = self.place
        super().move(action)
        if np.linalg.norm(self.crate - self.place) < 0.1:
            self.crate = self.crate + self.place - before

    def is_success(self):
        return np.linalg.norm(self.goal - self.crate) < 0.2

    def reward(self):
        return -np.linalg.norm(self.crate - self.place) - np.linalg.norm(self.goal - self.crate)


class BoatLeavesItsCrate(BoatFetchesItsCrate):
    def is_success(self):
        return np.linalg.norm(self.goal - self.place) < 0.2
