"""Boats that are paid for what changed since the step before, next to twins that keep the right value. They are written
in different ways: attributes, dictionaries, helper functions, loops, masks."""

import numpy as np
from robots import Boat


def gain(before, after):
    return 5.0 * (before - after)


class BoatAhead(Boat):
    """It is paid the way by which it comes nearer."""

    def start(self):
        super().start()
        self.previous_distance_to_goal = self.distance()

    def reward(self):
        distance = self.distance()
        progress = gain(self.previous_distance_to_goal, distance)
        self.keep(distance)
        return progress

    def keep(self, distance):
        self.previous_distance_to_goal = distance


class RL637BoatAheadFromTheStart(BoatAhead):
    rlctl_ignore = {"RL605": "what was paid once is paid until the end"}

    def keep(self, distance):
        pass


class BoatStrides(Boat):
    """It is paid for whole strides; targets of its motors are set in the same function."""

    def start(self):
        super().start()
        self.targets, self.last_error = np.zeros(2), self.distance()

    def step(self, action):
        self.steps += 1
        self.targets = np.clip(self.targets + 0.1 * action, -1, 1)
        self.move(self.targets)
        error = 0.0625 * np.ceil(16 * self.distance())
        progress = 4.0 * (self.last_error - error)
        self.last_error = error
        done = self.is_success()
        return self.observe(), float(progress), done, self.steps >= self.limit, {"is_success": done}


class BoatSmooth(Boat):
    """It pays for each change of its action."""

    def start(self):
        super().start()
        self.memory = {"last": np.zeros(2), "taken": np.zeros(2)}

    def move(self, action):
        super().move(action)
        self.memory["taken"] = action

    def reward(self):
        return super().reward() - 0.1 * self.change()

    def change(self):
        cost = 0.0
        for i in range(2):
            cost += (self.memory["taken"][i] - self.memory["last"][i]) ** 2
        self.memory["last"] = self.memory["taken"].copy()
        return cost


class RL620BoatSmoothTooEarly(BoatSmooth):
    def change(self):
        self.memory["last"] = self.memory["taken"].copy()
        cost = 0.0
        for i in range(2):
            cost += (self.memory["taken"][i] - self.memory["last"][i]) ** 2
        return cost


class BoatNormed(Boat):
    """It pays for the size of the change; the action before belongs to the class, and is given to a function."""

    def start(self):
        super().start()
        self.old, self.new = np.zeros(2), np.zeros(2)

    def move(self, action):
        self.old, self.new = self.new, action
        super().move(action)

    def reward(self):
        return super().reward() - 0.1 * float(np.linalg.norm(np.subtract(self.new, self.old)))


class RL620BoatNormedTooEarly(BoatNormed):
    def move(self, action):
        super().move(action)
        self.old = self.new


class BoatOnCourse(Boat):
    """It sails to three buoys, one after the other."""

    def start(self):
        super().start()
        self.buoys = [self.buoy, self.draw_buoy(), self.draw_buoy()]
        self.leg = 0
        self.prev_distance = self.distance()

    def distance(self):
        return float(np.linalg.norm(self.buoy - self.place))

    def reward(self):
        distance = self.distance()
        progress = self.prev_distance - distance
        self.prev_distance = distance
        if self.leg == 2:
            progress += 0.01
        elif distance < 0.2:
            self.go_on()
        return progress

    def go_on(self):
        self.leg += 1
        self.buoy = self.buoys[self.leg]
        self.prev_distance = self.distance()

    def is_success(self):
        return self.leg == 2 and self.distance() < 0.2

    def info(self, success):
        return {"is_success": success, "leg": self.leg}


class RL627BoatOnCourseOldBuoy(BoatOnCourse):
    def go_on(self):
        self.leg += 1
        self.buoy = self.buoys[self.leg]


class BoatInTime(BoatOnCourse):
    """The next buoy comes after some time; what is left of the way is kept as a negative number."""

    def start(self):
        super().start()
        self.last_potential = -self.distance()

    def reward(self):
        potential = -self.distance()
        shaped = potential - self.last_potential
        self.last_potential = potential
        if self.steps % 20 == 0 and self.leg < 2:
            self.go_on()
        return shaped

    def go_on(self):
        super().go_on()
        self.last_potential = -self.distance()


class RL627BoatInTimeOldBuoy(BoatInTime):
    def go_on(self):
        BoatOnCourse.go_on(self)


class BoatRestOfCourse(BoatOnCourse):
    """It is paid by what is left of the whole course, which goes on without a jump at a buoy."""

    def distance(self):
        if not hasattr(self, "buoys"):
            return super().distance()
        rest = sum(np.linalg.norm(self.buoys[i + 1] - self.buoys[i]) for i in range(self.leg, 2))
        return float(np.linalg.norm(self.buoys[self.leg] - self.place) + rest)

    def go_on(self):
        self.leg += 1
        self.buoy = self.buoys[self.leg]


class BoatsMask(BoatOnCourse):
    """It keeps arrays with an entry for each world, of which there is one."""

    def start(self):
        super().start()
        self.goals = np.array([self.buoy])
        self.last_distances = self.distances()

    def distances(self):
        return np.linalg.norm(self.goals - self.place, axis=1)

    def reward(self):
        distances = self.distances()
        progress = self.last_distances - distances
        self.last_distances = distances.copy()
        arrived = distances < 0.2
        if arrived.any():
            self.draw_goals(arrived)
        return float(progress.sum())

    def draw_goals(self, arrived):
        self.goals[arrived] = self.np_random.uniform(-1, 1, (arrived.sum(), 2))
        self.last_distances = self.distances()


class RL627BoatsMaskOldGoal(BoatsMask):
    rlctl_ignore = {"RL114": "the last distance is hidden", "RL611": "goals are drawn without end"}

    def draw_goals(self, arrived):
        self.goals[arrived] = self.np_random.uniform(-1, 1, (arrived.sum(), 2))


class BoatsWhere(BoatsMask):
    """It draws new goals for all worlds, and takes them where the last one is reached."""

    def reward(self):
        distances = self.distances()
        progress = self.last_distances - distances
        arrived = distances < 0.2
        drawn = self.np_random.uniform(-1, 1, self.goals.shape)
        self.goals = np.where(arrived[:, None], drawn, self.goals)
        self.last_distances = self.kept(distances)
        return float(progress.sum())

    def kept(self, _):
        return self.distances()


class RL627BoatsWhereOldGoal(BoatsWhere):
    rlctl_ignore = {"RL114": "the last distance is hidden", "RL611": "goals are drawn without end"}

    def kept(self, distances):
        return distances


class BoatPaddles(Boat):
    """Its two paddles touch the water where they go backwards; a stroke in the air is paid when one comes down."""

    def start(self):
        super().start()
        self.air, self.paddles = np.zeros(2), np.zeros(2)

    def move(self, action):
        super().move(action)
        self.paddles = action

    def reward(self):
        paid = 0.0
        for i in range(2):
            if self.paddles[i] < 0.3:
                if self.air[i] > 0:
                    paid += self.air[i] - 0.1
                self.air[i] = 0.0
            else:
                self.air[i] += 0.05
        return paid - self.distance()


class RL628BoatPaddlesInEachStep(BoatPaddles):
    def reward(self):
        paid = 0.0
        for i in range(2):
            self.air[i] += 0.05
            if self.paddles[i] < 0.3:
                if self.air[i] > 0:
                    paid += self.air[i] - 0.1
                self.air[i] = 0.0
        return paid - self.distance()


class BoatPaddlesAtOnce(BoatPaddles):
    """The same with arrays."""

    def reward(self):
        wet = self.paddles < 0.3
        was_up = self.air > 0
        paid = np.sum((self.air - 0.1) * np.logical_and(was_up, wet))
        self.air = (self.air + 0.05) * ~wet
        return float(paid) - self.distance()


class RL628BoatPaddlesAtOnceInEachStep(BoatPaddles):
    def reward(self):
        wet = self.paddles < 0.3
        self.air = self.air + 0.05
        was_up = self.air > 0
        paid = np.sum((self.air - 0.1) * np.logical_and(was_up, wet))
        self.air *= ~wet
        return float(paid) - self.distance()


class BoatPaddlesAtOnceTooLate(BoatPaddles):
    def reward(self):
        wet = self.paddles < 0.3
        self.air = (self.air + 0.05) * ~wet
        was_up = self.air > 0
        paid = np.sum((self.air - 0.1) * np.logical_and(was_up, wet))
        return float(paid) - self.distance()


class BoatStays(Boat):
    """It has to stay at its buoy for three steps."""

    def start(self):
        super().start()
        self.steps_held = 0

    def is_success(self):
        if self.distance() < 0.3:
            self.steps_held += 1
        else:
            self.steps_held = 0
        return self.steps_held >= 3


class RL641BoatStaysNowAndThen(BoatStays):
    def is_success(self):
        if self.distance() < 0.3:
            self.steps_held += 1
        return self.steps_held >= 3


class BoatStaysMasked(BoatStays):
    """The same with an array."""

    def start(self):
        super().start()
        self.hold_s = np.zeros(1)

    def is_success(self):
        inside = np.array([self.distance()]) < 0.3
        self.hold_s = (self.hold_s + 0.1) * inside
        return bool((self.hold_s >= 0.3)[0])


class RL641BoatStaysMaskedNowAndThen(BoatStaysMasked):
    def is_success(self):
        inside = np.array([self.distance()]) < 0.3
        self.hold_s = self.hold_s + np.where(inside, 0.1, 0.0)
        return bool((self.hold_s >= 0.3)[0])


class BoatOnCommand(Boat):
    """It is to sail at a speed, which changes every 20 steps."""

    def start(self):
        super().start()
        self.draw_command()
        self.shown = self.command

    def draw_command(self):
        self.command = self.np_random.uniform(-0.5, 0.5, 2)

    def size(self):
        return 8

    def observe(self):
        return np.concatenate([super().observe(), self.get_shown()]).astype(np.float32)

    def get_shown(self):
        return self.command

    def is_success(self):
        return False

    def info(self, _):
        return {"is_success": bool(np.abs(self.speed - self.command).max() < 0.1)}

    def reward(self):
        paid = -float(np.abs(self.speed - self.command).sum())
        if self.steps % 20 == 0:
            self.draw_command()
        return paid


class RL638BoatOnCommandShowsTheFirst(BoatOnCommand):
    rlctl_ignore = {"RL615": "the command changes, and nothing shows it"}

    def get_shown(self):
        return self.shown


class RL627BoatInTimeBuoyFirst(BoatInTime):
    """The next buoy comes before the progress to it is computed."""

    rlctl_ignore = {"RL611": "its buoys move on too often"}

    def reward(self):
        if self.steps % 30 == 0:
            self.buoy = self.draw_buoy()
        return Boat.reward(self) + self.gain()

    def gain(self):
        distance = self.distance()
        progress = self.prev_distance - distance
        self.prev_distance = distance
        return progress


class BoatShowsItsWay(Boat):
    """It observes the way to a place beside the buoy."""

    target = None

    def start(self):
        super().start()
        self.aim()

    def aim(self):
        self.target = self.buoy + np.array([0.1, 0.0])

    def size(self):
        return 8

    def observe(self):
        return np.concatenate([super().observe(), self.target - self.place]).astype(np.float32)


class RL638BoatKeepsItsFirstWay(BoatShowsItsWay):
    def aim(self):
        if self.target is None:
            self.target = self.buoy + np.array([0.1, 0.0])


class BoatFromItsBow(BoatShowsItsWay):
    """Distances are those of the bow, which is ahead of its place."""

    def bow(self):
        return self.place + np.array([0.15, 0.0])

    def distance(self):
        return float(np.linalg.norm(self.target - self.bow()))

    def observe(self):
        return np.concatenate([Boat.observe(self), self.target - self.bow()]).astype(np.float32)


class RL626BoatFromBothEnds(BoatFromItsBow):
    def observe(self):
        return np.concatenate([Boat.observe(self), self.target - self.place]).astype(np.float32)
