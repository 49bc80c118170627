"""RL119, RL819, RL820 and a part of RL810: what the observation has of a robot's joints and motion, compared with what
the engine has."""

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.families.readings import MOST_ELEMENTS, join_logs, name_features, read_features
from rlctl.checking.rule import RuleFinding, list_names
from rlctl.checking.world_logs import LoggedWorld, WorldLog
from rlctl.checking.worlds import JOINTS, Array, Joint, JointKey

EXACT = 2e-6  # relative; the last bits of float32
DEGREES = 180 / math.pi
LEAST_MOTION = 0.02  # standard deviation; calmer joints may be equal by chance [rad], [m], [rad/s], [m/s]
NEARLY_ALL = 0.98  # of all steps: an observation may be cut off in some
CLOSE, MOVING = 1e-3, 0.1
"""Parts of a velocity's standard deviation: differences of float32 positions, and what is not small."""
FEWEST_JOINTS = 2  # in a block whose order is compared
FEWEST_STEPS = 30
FIRST_STEPS = 8  # Values that differ in these are not compared further


@dataclasses.dataclass(frozen=True)
class JointCopy:
    """An element of the observation that is a joint's position or speed times a factor, plus a constant."""

    column: int
    body: int
    joint: Joint
    is_speed: bool
    factor: float

    @property
    def key(self) -> JointKey:
        """Its joint."""
        return self.body, self.joint.index

    @property
    def name(self) -> str:
        """What it copies, in words."""
        return f"the {'speed' if self.is_speed else 'position'} of joint {self.joint.name}"

    def is_scaled(self, factor: float) -> bool:
        """Say whether it is an angle, or its speed, times a factor."""
        return self.joint.is_angle and math.isclose(abs(self.factor), factor, rel_tol=10 * EXACT)


def find_misread_joints(world: LoggedWorld) -> Iterator[RuleFinding]:
    """Yield what is wrong with the units, the order and the time of joints and velocities in the observation."""
    if (joined := join_logs(world)) is None:
        return
    logs, observed = joined
    copies = _find_copies(logs, observed)
    yield from _find_degrees(copies)
    yield from _find_other_order(copies)
    yield from _find_wrong_time(world.time_step, logs)


def _find_copies(logs: Sequence[WorldLog], observed: Array) -> list[JointCopy]:
    """Return the elements that are a copy of one value of one joint."""
    copies: dict[int, list[JointCopy]] = {}
    centered = observed - observed.mean(axis=0)
    for i, body in enumerate(logs[0].world.bodies):
        states = np.array([state[i][JOINTS:] for log in logs for state in log.states])
        for number, values in enumerate(states.T):
            is_speed, joint = divmod(number, max(1, len(body.joints)))
            if not np.isfinite(values).all() or values.std() < LEAST_MOTION:
                continue
            feature = values - values.mean()
            factors = feature @ centered / (feature @ feature)
            sizes = np.abs(observed).max(axis=0) + np.abs(factors) * np.abs(values).max()
            off = np.abs(centered - factors * feature[:, None]).max(axis=0)
            for column in np.flatnonzero(
                (off <= EXACT * sizes) & (np.abs(factors) * values.std() > EXACT * sizes * 1e3)
            ):
                copy = JointCopy(int(column), body.id, body.joints[joint], bool(is_speed), float(factors[column]))
                copies.setdefault(copy.column, []).append(copy)
    return [found[0] for _, found in sorted(copies.items()) if len(found) == 1]


def _find_degrees(copies: Sequence[JointCopy]) -> Iterator[RuleFinding]:
    shrunk = [copy for copy in copies if copy.is_scaled(1 / DEGREES) and not copy.is_speed]
    for copy in shrunk[:1]:
        name = f"observation[{copy.column}]"
        message = f"{name} is {copy.name} times pi / 180: it was in radians already"
        yield RuleFinding("RL810", message, {"element": name, "value": copy.joint.name, "expected": "radians"})
    large, plain = ([copy for copy in copies if copy.is_scaled(factor)] for factor in (DEGREES, 1.0))
    if large and plain:
        name, unit = f"observation[{large[0].column}]", "rad/s" if plain[0].is_speed else "rad"
        more = (
            f" (likewise {list_names([f'observation[{copy.column}]' for copy in large[1:]], 4)})" if large[1:] else ""
        )
        other = f"observation[{plain[0].column}], {plain[0].name}, is in {unit}"
        message = f"{name} is {large[0].name} in degrees{more}, and {other}"
        yield RuleFinding("RL119", message, {"element": name, "value": large[0].factor, "expected": 1.0})


def _find_other_order(copies: Sequence[JointCopy]) -> Iterator[RuleFinding]:
    """Yield a block of speeds that has the joints of a block of positions in another order."""
    blocks = _find_blocks(copies)
    orders = [[copy.key for copy in block] for block in blocks if not block[0].is_speed]
    for block in (block for block in blocks if block[0].is_speed):
        order = [copy.key for copy in block]
        alike = [other for other in orders if sorted(other) == sorted(order)]
        if alike and order not in alike:
            positions = next(b for b in blocks if not b[0].is_speed and [c.key for c in b] == alike[0])
            names = [", ".join(copy.joint.name for copy in some) for some in (positions, block)]
            places = [f"observation[{some[0].column}:{some[-1].column + 1}]" for some in (positions, block)]
            message = f"{places[0]} are the positions of {names[0]}; {places[1]} are the speeds of {names[1]}"
            yield RuleFinding("RL819", message, {"element": places[1], "value": names[1], "expected": names[0]})
            return


def _find_blocks(copies: Sequence[JointCopy]) -> list[list[JointCopy]]:
    """Return the longest rows of consecutive elements that are positions, or speeds, of different joints."""
    blocks: list[list[JointCopy]] = []
    for copy in copies:
        last = blocks[-1] if blocks else []
        continues = last and (last[-1].column + 1, last[-1].is_speed) == (copy.column, copy.is_speed)
        if continues and copy.key not in {other.key for other in last}:
            last.append(copy)
        else:
            blocks.append([copy])
    return [block for block in blocks if len(block) >= FEWEST_JOINTS]


def _find_wrong_time(time_step: float, logs: Sequence[WorldLog]) -> Iterator[RuleFinding]:
    """Yield an element that is how far something moved in a control step, divided by the time of a physics step."""
    if (read := _read_changes(logs, time_step)) is None:
        return
    speeds, observed, substeps = read
    names = name_features(logs[0]) + [f"observation[{column}]" for column in range(observed.shape[1])]
    wrong = {}
    for column, values in enumerate(observed.T):
        if values.std() > LEAST_MOTION and (feature := _find_equal(values, speeds)) is not None:
            wrong[column] = names[feature]
    if wrong:
        column, name = next(iter(wrong.items()))
        others = [f"observation[{other}]" for other in list(wrong)[1:]]
        more = f" (likewise {list_names(others, 4)})" if others else ""
        what = f"observation[{column}] is the change of {name} in a step, divided by {time_step:.4g} s{more}"
        taken = f"the step takes {time_step * substeps:.4g} s, {substeps} steps of the physics"
        evidence = {"element": f"observation[{column}]", "value": time_step, "expected": time_step * substeps}
        yield RuleFinding("RL820", f"{what}; {taken}: it is {substeps} times too large", evidence)


def _read_changes(logs: Sequence[WorldLog], time_step: float) -> tuple[Array, Array, int] | None:
    """Return the changes of features of the state, and of the observation, in each step, divided by the time of a
    physics step; what was observed after the step; and how many physics steps it had. None if it had only one."""
    changes, observed, times = [], [], []
    for log in logs:
        seen = np.nan_to_num(np.stack(log.observed).astype(np.float64))[:, :MOST_ELEMENTS]
        states = [read_features(log, *look) for look in zip(log.states, log.poses, strict=True)]
        changes.append(np.diff(np.hstack([np.stack(states), seen]), axis=0))
        observed.append(seen[1:])
        times.append(np.diff(log.times))
    if len({part.shape[1] for part in changes}) > 1 or sum(map(len, changes)) < FEWEST_STEPS:
        return None
    substeps = float(np.median(np.concatenate(times))) / time_step
    if not substeps > 1.5:
        return None
    return np.concatenate(changes) / time_step, np.concatenate(observed), round(substeps)


def _find_equal(values: Array, features: Array) -> int | None:
    """Return the feature that values equal, up to its sign, in nearly all steps, also where they are not small."""
    allowed = CLOSE * values.std()
    moving = np.flatnonzero(np.abs(values) > MOVING * values.std())
    if len(moving) < FEWEST_STEPS // 2:
        return None
    few = moving[:: max(1, len(moving) // FIRST_STEPS)]
    for sign in (1.0, -1.0):
        part = (np.abs(values[few, None] - sign * features[few]) <= allowed).mean(axis=0)
        for feature in np.flatnonzero(part >= 1 - 1.5 / len(few)).tolist():
            near = np.abs(values - sign * features[:, feature]) <= allowed
            if min(near.mean(), near[moving].mean()) >= NEARLY_ALL:
                return int(feature)
    return None
