"""The table of all that play: what each is called, what it stands for, and how it plays where it applies."""

import contextlib
import dataclasses
import enum
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.audit import leading, reaching, walking
from rlctl.checking.audit.play_world import COMMANDED, Array, PlayedEpisode, PlayWorld, Script
from rlctl.checking.episode import action_at, find_action_range
from rlctl.checking.instance import Context, EnvironmentRaised, Instance
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import NotJudged
from rlctl.environments.info import describe_worlds
from rlctl.environments.leaves import find_leaves
from rlctl.policy.actor import Actor, Rows, act_one_by_one
from rlctl.policy.load import load_actor
from rlctl.policy.named_actors import RandomActor, ZeroActor
from rlctl.policy.policy import FileActor
from rlctl.task.body import Body

Kind = enum.StrEnum("Kind", ["wanted", "moved", "idle", "part", "learned"])
"""`wanted` acts as is wanted, `moved` is moved so by the engine, `idle` does not try, `part` does less than is wanted,
`learned` is the policy of a run."""
DRIFT, SWING, SWING_HZ = 0.1, 0.25, 2.0  # parts of the range of an action; how often it swings
SLOW = 0.1  # [m/s], of a robot that drifts
SHORTEST = 3  # [steps]; what ends an episode earlier has fallen
NOT_MOVING = np.zeros(3)


class Plays:
    """The plays of one environment: what was found out about it, for all competitors."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self.world = PlayWorld(context.instance)
        self.walker = walking.find_walker(self.world)
        self._stances: dict[int, walking.SettledPose] = {}
        self._goal: reaching.Goal | None = None
        self._has_searched = False
        self._ways: dict[int, reaching.Way | None] = {}
        self._others: dict[Path, tuple[PlayWorld, FileActor]] = {}

    @functools.cached_property
    def lead(self) -> leading.Lead | None:
        """The goal or the velocity that resets draw; None for a task, whose bodies can be moved."""
        if self.world.task_env is not None:
            return None
        try:
            return leading.find_lead(self.context)
        except (EnvironmentRaised, NotJudged):  # its goal is moved where it may never be; time ran out
            return None

    @functools.cached_property
    def seeds(self) -> Sequence[int]:
        """The seeds of the rounds."""
        count = len(COMMANDED)
        with contextlib.suppress(EnvironmentRaised, NotJudged):  # as above; an episode without a goal
            if self.lead is not None:
                return self.lead.list_seeds(count)
        return range(FIRST_SEED, FIRST_SEED + count)

    def stance(self, seed: int, number: int) -> walking.SettledPose:
        """Return how the robot with a free base stands in the episode of a seed."""
        assert self.walker is not None
        if seed not in self._stances:
            self.world.begin(seed, number)

            def settle(steps: int) -> None:
                self.world.play(Script(self.still()), "", seed, number, steps)

            self._stances[seed] = walking.find_stance(self.world, self.walker, settle)
        return self._stances[seed]

    def way(self, seed: int, number: int) -> reaching.Way | None:
        """Return the way to the goal of the episode of a seed; None where there is none."""
        if not self._has_searched:
            self._has_searched = True
            self._goal = reaching.find_goal(self.world, seed, number)
        if self._goal is None:
            return None
        if seed not in self._ways:
            self._ways[seed] = reaching.find_way(self.world, self._goal, seed, number)
        return self._ways[seed]

    def still(self) -> Actor:
        """Return an actor that does nothing."""
        return ZeroActor(self.world.space)

    def policy(self, file: Path) -> tuple[PlayWorld, FileActor]:
        """Return an instance that observes as a policy needs it, and its actor; raises `ArtifactError`."""
        if file not in self._others:
            actor = load_actor(file)
            instance = self.context.build(spec=self.context.spec.observe_as(actor.info.spec))
            world = PlayWorld(instance)
            actor.info.check_fits(describe_worlds(world.worlds), file)
            self._others[file] = world, actor
        return self._others[file]

    def close(self) -> None:
        """Close the instances of policies."""
        for world, actor in self._others.values():
            actor.close()
            world.instance.close()


Prepare = Callable[[Plays, int, int], Script | None]
"""Returns how it plays the episode of a seed in a round, or None where it does not apply."""


@dataclasses.dataclass(frozen=True)
class Competitor:
    """One that plays."""

    name: str
    kind: Kind
    prepare: Prepare
    is_moved: bool = False  # by the engine, without any effort
    lesson: str = ""  # what a policy has learned that plays so: `to stand`
    does_nothing: bool = False  # what others earn beyond it, they earn by what they do


class Pattern(Actor):
    """Acts by seed and step alone: `points` returns fractions of the range of the action, shape (numbers,)."""

    def __init__(self, space: Any, points: Callable[[int, int], Array]) -> None:
        self._space, self._points = space, points

    def act(self, observations: Any, rows: Rows) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the action of each row for its seed and step."""
        return act_one_by_one(observations, rows, self._act_once)

    def _act_once(self, observation: Any, row: int, seed: int, step: int) -> Any:
        return action_at(self._space, self._points(seed, step))


def find_middle(space: Any) -> Array:
    """Return the fractions of the range that are no action, shape (numbers,); see `action_at`."""
    points = []
    for leaf in find_leaves(space):
        low, high = (np.ravel(bound) for bound in find_action_range(leaf))
        points.append((np.clip(0.0, low, high) - low) / np.maximum(high - low, 1e-9))
    return np.concatenate(points)


def _act(points: Callable[[Array, int, int], Array]) -> Prepare:
    """Return how a competitor plays that only acts: `points` is given the middle, the seed and the step."""

    def prepare(plays: Plays, seed: int, number: int) -> Script:
        middle = find_middle(plays.world.space)
        return Script(Pattern(plays.world.space, lambda own_seed, step: points(middle, own_seed, step)))

    return prepare


def _saturate(middle: Array, seed: int, step: int) -> Array:
    return np.random.default_rng(seed).integers(0, 2, middle.size).astype(float)


def _tremble(middle: Array, seed: int, step: int) -> Array:
    return np.full(middle.size, float(step % 2))


def _drift(middle: Array, seed: int, step: int) -> Array:
    return np.clip(middle + DRIFT, 0.0, 1.0)


def _do_nothing(plays: Plays, seed: int, number: int) -> Script:
    return Script(plays.still())


def _act_randomly(plays: Plays, seed: int, number: int) -> Script:
    return Script(RandomActor(plays.world.space))


def _hold_still(plays: Plays, seed: int, number: int) -> Script | None:
    if plays.walker is not None:
        return _glide(plays, seed, number, lambda: NOT_MOVING)
    arms = [] if plays.world.sim is None else [body for body in plays.world.sim.bodies.values() if _is_arm(body)]
    if not arms:
        return None
    starts: list[Array] = []

    def start() -> None:
        starts.extend(body.joint_positions.copy() for body in arms)

    def move(step: int) -> None:
        for body, joints in zip(arms, starts, strict=True):
            body.set_joints(joints)

    return Script(plays.still(), start, move)


def _is_arm(body: Body) -> bool:
    return body.fixed and bool(body.joint_names)


def _glide(
    plays: Plays, seed: int, number: int, read_velocity: Callable[[], Array], actor: Actor | None = None
) -> Script | None:
    """Move the base at a velocity; with an actor the joints move by themselves."""
    if plays.walker is None:
        return None
    glide = walking.Glide(
        plays.walker,
        plays.stance(seed, number),
        plays.world.control_dt,
        read_velocity,
        holds_joints=actor is None,
    )
    return Script(actor or plays.still(), glide.start, glide.move)


def _follow(factor: float, *, steps: bool = False) -> Prepare:
    """Return how the base is moved at a factor of the commanded velocity, with legs that step or as they stand."""

    def prepare(plays: Plays, seed: int, number: int) -> Script | None:
        if plays.walker is None or plays.world.ask(plays.world.read_velocity) is None:
            return None
        legs = _find_swing(plays) if steps else None
        if steps and legs is None:
            return None
        return _glide(plays, seed, number, lambda: factor * _read_velocity(plays.world), legs)

    return prepare


def _read_velocity(world: PlayWorld) -> Array:
    velocity = world.read_velocity()
    assert velocity is not None
    return velocity


def _slide(plays: Plays, seed: int, number: int) -> Script | None:
    return _glide(plays, seed, number, lambda: np.array([0.0, SLOW, 0.0]))


def _step_in_place(plays: Plays, seed: int, number: int) -> Script | None:
    legs = _find_swing(plays)
    return None if legs is None else _glide(plays, seed, number, lambda: NOT_MOVING, legs)


def _find_swing(plays: Plays) -> Actor | None:
    """Return an actor that swings legs by turns; None for a robot whose action does not name the joints of legs."""
    joints = None if plays.walker is None else plays.world.ask(plays.world.read_joints)
    if joints is None:
        return None
    limbs = [name.split("_")[0] for name in joints.names]
    names = list(dict.fromkeys(limbs))
    if len(names) < 2 or len(names) == len(limbs):
        return None
    signs = np.array([1.0 if names.index(limb) % 2 == 0 else -1.0 for limb in limbs])
    middle, turn = find_middle(plays.world.space), 2 * np.pi * SWING_HZ * plays.world.control_dt

    def points(seed: int, step: int) -> Array:
        return np.clip(middle + SWING * signs * np.sin(turn * step), 0.0, 1.0)

    return Pattern(plays.world.space, points)


def _lies_on(played: PlayedEpisode) -> bool:
    return not played.is_terminated or played.steps > SHORTEST


def _has_fallen(played: PlayedEpisode) -> bool:
    return played.is_terminated and played.steps <= SHORTEST


def _lie(side: str, accepts: Callable[[PlayedEpisode], bool] = _lies_on) -> Prepare:
    def prepare(plays: Plays, seed: int, number: int) -> Script | None:
        if plays.walker is None:
            return None
        walker, stance = plays.walker, plays.stance(seed, number)
        rotation = walking.SIDES[side]
        return Script(plays.still(), lambda: walking.lay_down(walker, stance, rotation), accepts=accepts)

    return prepare


def _reach_by_actions(plays: Plays, seed: int, number: int) -> Script | None:
    way = plays.way(seed, number)
    return None if way is None else _drive(plays, way, way.goal)


def _drive(plays: Plays, way: reaching.Way, end: Array) -> Script | None:
    if not isinstance(way.mover, reaching.LinkMover):
        return None
    try:
        return Script(reaching.Driven(plays.world, way.mover.body, end))
    except LookupError:
        return None


def _reach_by_engine(plays: Plays, seed: int, number: int) -> Script | None:
    way = plays.way(seed, number)
    return None if way is None else _move_to(plays, way, way.goal)


def _move_to(plays: Plays, way: reaching.Way, end: Array) -> Script:
    return Script(plays.still(), move=reaching.Moved(plays.world, way, end).move)


def _bring_goal(plays: Plays, seed: int, number: int) -> Script | None:
    lead = plays.lead
    return None if lead is None or lead.source is None else lead.prepare(plays.still(), seed, plays.world.longest)


def _stand_as_commanded(plays: Plays, seed: int, number: int) -> Script | None:
    lead = plays.lead
    return None if lead is None or lead.source is not None else lead.prepare(plays.still(), seed, plays.world.longest)


def _hover(plays: Plays, seed: int, number: int) -> Script | None:
    if plays.lead is not None:
        part = plays.lead.find_hover(seed)
        return None if part is None else plays.lead.prepare(plays.still(), seed, plays.world.longest, part)
    way = plays.way(seed, number)
    beside = None if way is None else reaching.find_hover(plays.world, way, seed, number)
    if way is None or beside is None:
        return None
    return _drive(plays, way, beside) or _move_to(plays, way, beside)


def play_policy(file: Path) -> Prepare:
    """Return how a policy file plays."""

    def prepare(plays: Plays, seed: int, number: int) -> Script:
        world, actor = plays.policy(file)
        return Script(actor, world=world)

    return prepare


WANTED = (
    Competitor("following the command", Kind.moved, _follow(1.0), lesson="to follow the command"),
    Competitor(
        "following the command with steps", Kind.moved, _follow(1.0, steps=True), lesson="to follow the command"
    ),
    Competitor("reaching the goal", Kind.wanted, _reach_by_actions, lesson="to reach the goal"),
    Competitor("being at the goal", Kind.moved, _reach_by_engine, lesson="to be at the goal"),
    Competitor("being met by the goal", Kind.moved, _bring_goal, lesson="to be at the goal"),
    Competitor("standing as commanded", Kind.moved, _stand_as_commanded, lesson="to stand where that is commanded"),
)
OTHERS = (
    Competitor("standing still", Kind.idle, _hold_still, is_moved=True, lesson="to stand", does_nothing=True),
    Competitor("doing nothing", Kind.idle, _do_nothing, lesson="to do nothing", does_nothing=True),
    Competitor("falling at once", Kind.idle, _lie("on its back", _has_fallen), lesson="to fall at once"),
    Competitor(
        "half of the commanded speed",
        Kind.part,
        _follow(0.5),
        is_moved=True,
        lesson="to follow at half of the speed",
    ),
    Competitor(
        "the reversed command", Kind.idle, _follow(-1.0), is_moved=True, lesson="to do the reverse of the command"
    ),
    Competitor("hovering beside the goal", Kind.part, _hover, is_moved=True, lesson="to hover beside the goal"),
    Competitor("stepping in place", Kind.idle, _step_in_place, is_moved=True, lesson="to step in place"),
    *(Competitor(f"lying {side}", Kind.idle, _lie(side), lesson=f"to be lying {side}") for side in walking.SIDES),
    Competitor("trembling", Kind.idle, _act(_tremble), lesson="to tremble"),
    Competitor("saturating", Kind.idle, _act(_saturate), lesson="to saturate its actions"),
    Competitor("sliding slowly aside", Kind.idle, _slide, is_moved=True, lesson="to slide aside"),
    Competitor("drifting", Kind.idle, _act(_drift), lesson="to drift"),
    Competitor("acting randomly", Kind.idle, _act_randomly, lesson="nothing yet: it earns what random actions earn"),
)
"""In the order in which they play, the simple ones first: of two that earn as much the first is named."""
SHIPPED, LEARNED = "the shipped policy", "the learned policy"


def list_competitors(shipped: Path | None = None, learned: Path | None = None) -> list[Competitor]:
    """Return all competitors, with the policy that the task ships and the policy of a run, where there are any."""
    competitors = [*WANTED, *OTHERS]
    if shipped is not None:
        competitors.insert(0, Competitor(SHIPPED, Kind.wanted, play_policy(shipped)))
    if learned is not None:
        competitors.insert(0, Competitor(LEARNED, Kind.learned, play_policy(learned)))
    return competitors


def check_instance(instance: Instance) -> str:
    """Return why nobody can play in an environment; empty if all can."""
    leaves = find_leaves(instance.env.action_space)
    if len(leaves) != 1 or leaves[0].path or not leaves[0].supported:
        return f"competitors act in a Box or in discrete actions, not in {instance.env.action_space}"
    return ""
