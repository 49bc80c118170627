"""A robot that is not there: LeRobot's contract, the numbers of an SO-101, and servos of first order."""

import math
import time

JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
NAMES = [f"{joint}.pos" for joint in JOINTS]
START = dict.fromkeys(NAMES, 10.0)  # [deg], and percent of the gripper's opening
TIME_CONSTANT = 0.03  # [s], in which a servo has 63 % of its way behind it
TOP_SPEED = 172.0  # [deg/s], the 3 rad/s of the task


class StandIn:
    """An arm whose joints follow their targets; `clock` has the functions of `time` that it and the program use.

    `exchanged` are two names whose cables are exchanged: each motor gets the target of the other one.
    """

    name = "stand_in"
    observation_features = dict.fromkeys(NAMES, float)
    action_features = dict.fromkeys(NAMES, float)
    is_calibrated = True

    def __init__(self, clock=time, exchanged=()):
        self._clock, self._exchanged = clock, exchanged
        self._positions, self._targets = dict(START), dict(START)
        self.sent = {}  # the last action
        self._at = clock.perf_counter()
        self.is_connected = False

    def connect(self, calibrate=True):
        self.is_connected = True
        self._at = self._clock.perf_counter()

    def calibrate(self):
        pass

    def configure(self):
        pass

    def disconnect(self):
        self.is_connected = False

    def get_observation(self):
        self._move()
        return dict(self._positions)

    def send_action(self, action):
        self._move()
        self.sent = dict(action)
        for name, target in action.items():
            motor = name
            if name in self._exchanged:
                first, second = self._exchanged
                motor = second if name == first else first
            self._targets[motor] = target
        return dict(action)

    def _move(self):
        if not self.is_connected:
            raise ConnectionError("the stand-in is not connected")
        now = self._clock.perf_counter()
        seconds, self._at = now - self._at, now
        share = 1 - math.exp(-seconds / TIME_CONSTANT)
        for name, target in self._targets.items():
            way = share * (target - self._positions[name])
            self._positions[name] += max(-TOP_SPEED * seconds, min(TOP_SPEED * seconds, way))
