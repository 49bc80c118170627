"""RL120: mirror symmetry is wrong."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import INSTANCES, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.values import is_task
from rlctl.task.mirror import ACTION, Mirror

RULE = Rule(
    "RL120",
    "mirror symmetry is wrong",
    Severity.ERROR,
    meaning="""
        The task declares how its mirror image is observed and acts (`mirror`), but in the simulation the
        mirrored actions, from the mirror image of a state, do not give the mirror image of the next state, or
        earn another reward. A training with `mirror: true` would learn from steps that never happen.
    """,
    fix="""
        Correct the entry that the message names, or the action's or a joint's that it follows from: per element
        of the mirrored array which element it is, counted from 1, with its sign. Reflect vectors as (1, -2, 3),
        angular velocities as (-1, 2, -3), and exchange the joints of both sides.
    """,
    shows_one=True,
)

TRIALS, STEPS = 3, 4
LIFT = 1.0  # [m], of free bodies: in flight no contact and no bump of the ground is on one side only
TURN, SPEED, BEND, JOINT_SPEED = 0.4, 0.5, 0.15, 0.5  # [-] of a quaternion, [m/s], [rad], [rad/s]: of the random states
WIDEST = 1.0  # of random actions
ALLOWED = 0.1  # of the largest value of a name in a trial: robots are not exactly symmetric
LEAST = 1e-3  # a difference below it is rounding
Array = NDArray[np.float64]
_REFLECTED = np.array([-1.0, 1.0, -1.0, 1.0])  # signs of a quaternion (x, y, z, w), of a reflection in the x-z plane
_ACROSS = np.array([1.0, -1.0, 1.0])


@dataclasses.dataclass
class _Pose:
    """The random state of a body, or its mirror image."""

    position: Array
    orientation: Array
    velocity: Array
    joints: Array  # positions, then velocities; shape (2, joints)


@experiment("mirror", INSTANCES, 40, RULE, seeds_globals=True, alters=True)
def compare_mirror_images(context: Context) -> Iterator[ChildMessage]:
    """Take steps from random states in flight, and the mirrored steps from their mirror images."""
    env = context.instance.env
    if not is_task(env) or not env.unwrapped.task.mirror:
        raise NotApplicable("it declares no mirror symmetry")
    # Events may draw other values for the left side than for the right one.
    with context.fresh(spec=dataclasses.replace(context.spec, randomize=False, events={})) as instance:
        trial = _Trial(instance)
        for seed in range(FIRST_SEED, FIRST_SEED + TRIALS):
            ours, theirs = (trial.play(seed, mirrored=mirrored) for mirrored in (False, True))
            if finding := trial.compare(ours, theirs, seed):
                yield finding
                return


class _Trial:
    def __init__(self, instance: Instance) -> None:
        self._instance = instance
        self.env: Any = instance.env.unwrapped
        self.task, self.sim = self.env.task, self.env.sim
        self._mirrors = {name: Mirror(places) for name, places in self.task.mirror.items()}
        joints = self.task.describe_joints()
        if joints is None:
            raise NotJudged("the task has no describe_joints(), which tells which joint the mirror image of a joint is")
        places = self.task.mirror[ACTION]
        self._other = {joints.names[k]: (joints.names[abs(n) - 1], np.sign(n)) for k, n in enumerate(places)}

    def play(self, seed: int, *, mirrored: bool) -> list[dict[str, Array]]:
        """Return what is observed and rewarded at the start and after each step, by name."""
        self._instance.reset(seed)
        rng = np.random.default_rng(seed)
        for body in self.sim.bodies.values():
            pose = self._draw_pose(body, rng)
            self._place(body, self._reflect(body, pose) if mirrored else pose)
        if mirrored:
            self._reflect_attributes()
        seen = [self._call("observe", self.env.observe_exactly)]
        for step in range(1, STEPS + 1):
            action = rng.uniform(-WIDEST, WIDEST, self.env.action_space.shape).astype(np.float32)
            action = self._mirrors[ACTION](action) if mirrored else action
            seen.append(self._step(np.clip(action, self.env.action_space.low, self.env.action_space.high), step))
        return seen

    def _step(self, action: NDArray[np.float32], step: int) -> dict[str, Array]:
        worlds, rows = self.env.worlds, action[None]
        self._call("act", worlds.calls.act, rows, step=step)
        self._call("step", self.sim.step, step=step)
        self._call("is_terminated", worlds.calls.is_terminated, step=step)
        terms = self._call("rewards", worlds.rewards, rows, step=step)[0, 1:]
        observed = self._call("observe", self.env.observe_exactly, step=step)
        weighted = zip(worlds.weights.items(), terms.tolist(), strict=True)
        paid = {name: value for (name, weight), value in weighted if weight}  # others may measure a place in the world
        return {**observed, **{f"reward term {name}": np.array([value]) for name, value in paid.items()}}

    def _call(self, name: str, function: Any, *arguments: Any, step: int = 0) -> Any:
        values = self._instance.call(name, function, *arguments, step=step)
        return {key: np.array(value, float) for key, value in values.items()} if isinstance(values, dict) else values

    def _draw_pose(self, body: Any, rng: np.random.Generator) -> _Pose:
        orientation, joints = np.array(body.base_orientation, float), np.array(body.joint_positions, float)
        position, velocity = np.array(body.base_position, float), np.zeros(3)
        if not body.fixed:
            orientation = orientation + rng.uniform(-TURN, TURN, 4)
            orientation /= np.linalg.norm(orientation)
            position[2] += LIFT
            velocity = rng.uniform(-SPEED, SPEED, 3)
        moved = joints + rng.uniform(-BEND, BEND, joints.shape)
        return _Pose(
            position, orientation, velocity, np.stack([moved, rng.uniform(-JOINT_SPEED, JOINT_SPEED, joints.shape)])
        )

    def _reflect(self, body: Any, pose: _Pose) -> _Pose:
        joints = pose.joints.copy()
        names = list(body.joint_names)
        for place, name in enumerate(names):
            if name not in self._other:
                raise NotJudged(f"joint {name!r} is not one of describe_joints(): its mirror image is not known")
            other, sign = self._other[name]
            joints[:, place] = sign * pose.joints[:, names.index(other)]
        return _Pose(pose.position * _ACROSS, pose.orientation * _REFLECTED, pose.velocity * _ACROSS, joints)

    def _place(self, body: Any, pose: _Pose) -> None:
        if not body.fixed:
            body.set_base(pose.position, pose.orientation)
        if pose.joints.size:
            body.set_joints(pose.joints[0], pose.joints[1])
        if not body.fixed:
            body.add_velocity(pose.velocity)

    def _reflect_attributes(self) -> None:
        """Mirror what the task keeps under the name of an observation, such as a command."""
        owner = self.task
        for name, mirror in self._mirrors.items():
            value = getattr(owner, name, None)
            if isinstance(value, np.ndarray) and value.shape[-1:] == (len(self.task.mirror[name]),):
                setattr(owner, name, mirror(value))

    def compare(self, ours: list[dict[str, Array]], theirs: list[dict[str, Array]], seed: int) -> RuleFinding | None:
        """Return a finding about the first name whose mirrored values differ from those of the mirror image."""
        for step, (own, other) in enumerate(zip(ours, theirs, strict=True)):
            for name, values in own.items():
                expected = self._mirrors[name](values.ravel()) if name in self._mirrors else values.ravel()
                far = np.abs(expected - other[name].ravel())
                largest = max(float(np.abs(seen[name]).max()) for seen in ours if name in seen)
                if (far > max(ALLOWED * largest, LEAST)).any():
                    return _describe(name, int(far.argmax()), step, expected, other[name].ravel(), seed)
        return None


def _describe(name: str, element: int, step: int, expected: Array, actual: Array, seed: int) -> RuleFinding:
    when = "at the start" if step == 0 else f"after {step} step{'s' * (step > 1)}"
    is_reward = name.startswith("reward term")
    what = name if is_reward else f"{name}[{element}]"
    message = (
        f"{when} from a mirrored state, with mirrored actions, {what} is {actual[element]:.4g}; "
        f"{'the other side earns' if is_reward else 'the declaration says'} {expected[element]:.4g}"
    )
    evidence = {"element": name, "index": element, "step": step, "seed": seed, "value": float(actual[element])}
    return RuleFinding(RULE, message, {**evidence, "expected": float(expected[element])})
