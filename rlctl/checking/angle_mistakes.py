"""Where a source mixes degrees and radians, converts an angle wrongly, or gives degrees to what takes radians."""

import ast
from collections.abc import Iterator, Mapping

from rlctl.checking.angle_limits import AngleLimits
from rlctl.checking.angle_readings import STATES, AngleReadings
from rlctl.checking.angle_units import Angle, Unit, list_factors, read_words
from rlctl.checking.assignments import list_assignments, read_key, read_name
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.source_code import FaultyCode, Function, walk_own, write_code

TARGETS: Mapping[str, tuple[int, set[str]]] = {
    "resetJointState": (2, {"targetValue"}),
    "resetJointStateMultiDof": (2, {"targetValue"}),
    "setJointMotorControl2": (9, {"targetPosition", "targetVelocity"}),
    "setJointMotorControlArray": (9, {"targetPositions", "targetVelocities"}),
    "drive_to": (0, {"positions"}),
    "set_joints": (0, {"positions"}),
}
"""Calls that take positions of joints: by place, and by name."""
GAIN_WORDS = {"stiffness", "damping", "kp", "kd", "positionGain", "velocityGain", "positionGains", "velocityGains"}
ADDED_TO = {"qpos", "qvel", "joint_positions"}
HELD = STATES - {"jnt_range"}


class AngleMistakes:
    """Those of the environment's functions."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.readings = noted, noted.share(AngleReadings)
        self.of_targets: list[FaultyCode] = []
        self.of_mixtures: list[FaultyCode] = []
        for function in noted.own_functions:
            for node in walk_own(function):
                if isinstance(node, ast.expr) and noted.source.find(node) is not None:
                    self.readings.find(node, function)
                if isinstance(node, ast.Call):
                    self._read_given(node, function)
            self._read_assigned(function)
        found = [self._make(one.node, one.what) for one in self.readings.mixed.values() if not one.takes_radians]
        found += [self._make(*entry) for entry in AngleLimits(noted).find_compared()]
        self.of_functions = [
            self._make(one.node, one.what) for one in self.readings.mixed.values() if one.takes_radians
        ]
        self.of_mixtures = [] if self.of_functions or self.of_targets else [*self.of_mixtures, *found]

    def _make(self, node: ast.expr, what: str) -> FaultyCode:
        return FaultyCode(node, f"{write_code(node)} {what}", self.noted.source.find_place(node))

    def _read_given(self, call: ast.Call, function: Function) -> None:
        place, words = TARGETS.get(read_name(call.func), (len(call.args), set[str]()))
        given = call.args[place : place + 1] + [word.value for word in call.keywords if word.arg in words]
        for value in given:
            if (angle := self._find_degrees(value, function)) is not None:
                what = f"gives degrees ({angle.why}) to joints, whose angles are in radians"
                self.of_targets.append(self._make(call, what))
        for word in call.keywords:
            if word.arg in GAIN_WORDS:
                self._read_gain(call, word.value, function)

    def _read_gain(self, call: ast.Call, value: ast.expr, function: Function) -> None:
        parts = [value, *(factor for factor, _ in list_factors(value).others)]
        wrong = (Unit.PER_DEGREE, Unit.RADIANS, Unit.DEGREES)
        angle = next((one for part in parts if (one := self.readings.find(part, function)) and one.unit in wrong), None)
        if angle is not None:
            was = "is converted as an angle" if angle.unit is not Unit.PER_DEGREE else "is one per degree"
            what = f"{was} ({angle.why}): gains of joints are per radian"
            self.of_mixtures.append(
                FaultyCode(value, f"{write_code(value)} {what}", self.noted.source.find_place(call))
            )

    def _find_degrees(self, value: ast.expr, function: Function) -> Angle | None:
        angle = self.readings.find(value, function)
        return angle if angle is not None and angle.unit is Unit.DEGREES else None

    def _read_assigned(self, function: Function) -> None:
        for one in list_assignments(function):
            if one.is_part or one.element is not None:
                continue
            name = read_key(one.target).rpartition(".")[2] or read_name(one.target)
            angle, called = self.readings.find(one.value, function), read_words(name)
            if angle is None or angle.is_weighted:
                continue
            if angle.unit is Unit.DEGREES and name in HELD:
                self.of_targets.append(self._make(one.value, f"puts degrees ({angle.why}) into {name}"))
            elif called is not None and {called.unit, angle.unit} == {Unit.DEGREES, Unit.RADIANS}:
                what = f"is {angle.unit.value} ({angle.why}), and what it is kept in is called {name}"
                self.of_mixtures.append(self._make(one.value, what))


def find_first(rule: Rule, mistakes: list[FaultyCode]) -> Iterator[RuleFinding]:
    """Yield the first mistake of a list; what follows from it is known then."""
    for one in mistakes[:1]:
        evidence = {"element": write_code(one.node), "value": len(mistakes)}
        yield RuleFinding(rule, one.what, evidence, where=one.where)
