"""The experiment `attributes`: logs what an instance holds in its attributes, for rules about robots of any kind.

A robot that is written in NumPy has its state there, and clocks and other things that are counted are there in all.
"""

import ast
import contextlib
import dataclasses
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.bullet_worlds import read_states, read_world
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.loops import find_control_times, find_repeats
from rlctl.checking.records import FIRST_SEED, ChildMessage, Fact, Records
from rlctl.checking.rule import NotJudged
from rlctl.checking.term_names import is_about_steps, is_paid
from rlctl.checking.term_weights import find_action_terms, find_weighed_terms
from rlctl.checking.transitions import flatten_floats, list_float_parts
from rlctl.checking.values import (
    NUMBERS,
    ArrayNames,
    Attribute,
    find_author,
    find_numbers,
    fits_float,
    flatten_action,
    list_own_classes,
    parse_sources,
    read_attributes,
)
from rlctl.checking.worlds import JOINTS, World
from rlctl.environments.bullet_calls import BulletCalls, record_calls
from rlctl.environments.bullet_clients import ClientCalls
from rlctl.environments.simulations import find_mujoco

EPISODES = ("random", "repeated", "extreme", "random", "zero", "zero", "zero")
"""How the actions of each episode are chosen; with none for robots only whose reward has terms about steps."""
STEPS, ZERO_STEPS = 30, 200  # of an episode; of one in which a robot comes to stand
FEW_STEPS = 3  # in which an attribute has to change to be logged
MOST_NUMBERS = 400
WEIGHED_TERMS = "weighed terms"
"""The fact with what `find_weighed_terms` returns."""
ACTION_TERMS = "terms of actions"
"""The fact with what `find_action_terms` returns."""
RATES = ("render_fps", "video.frames_per_second")
"""Where metadata has the frame rate [Hz]."""
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class AttributeLog:
    """What was logged at each look: after the reset, and after each step of some episodes."""

    names: list[str]  # of the numbers that change: `self.velocity[0]`
    values: Numbers  # Shape (looks, names)
    observed: Numbers  # The numbers that are floats. Shape (looks, elements)
    parts: ArrayNames  # of what is observed
    actions: Numbers  # Shape (looks, numbers); 0 at a reset
    rewards: Numbers  # Shape (looks,); NaN at a reset, and where it is no number
    infos: Mapping[str, Numbers]  # numbers of info by name. Shape (looks,) each; NaN where there is none
    speeds: Numbers  # of joints that the engine has; in MuJoCo all of qvel. Shape (looks, speeds)
    seconds: Numbers  # that the engine has simulated. Shape (looks,); NaN without an engine
    physics_s: float  # one step of the engine [s]; NaN without one
    episodes: NDArray[np.int64]  # Shape (looks,)
    declared: Mapping[str, float]  # numbers of the object, its class and its module that do not change, by name
    literals: tuple[float, ...]  # numbers in the source of its classes
    repeats: Mapping[str, int]  # how often loops of a step repeat, by what their `range` has
    control_times: tuple[float, ...]  # of a whole step, as the source divides or multiplies times by these numbers [s]

    @property
    def is_step(self) -> NDArray[np.bool_]:
        """Whether a look is after a step, and not after a reset. Shape (looks,)."""
        return np.asarray(np.concatenate([[False], self.episodes[1:] == self.episodes[:-1]]))

    def changes(self, rows: Numbers) -> Numbers:
        """Return how rows change in each step. Shape (steps, columns)."""
        steps = np.flatnonzero(self.is_step)
        return np.asarray(rows[steps] - rows[steps - 1])


def find_log_without_engine(records: Records) -> AttributeLog | None:
    """Return what was logged of a robot without an engine; None where there is one, which tells more, or no log."""
    log: AttributeLog | None = records.facts.get("attributes")
    return log if log is not None and not np.isfinite(log.physics_s) else None


@experiment("attributes", PROBE, 107, share=0.2, seeds_globals=True)
def log_attributes(context: Context) -> Iterator[ChildMessage]:
    """Play a few short episodes and read the attributes that change after each step."""
    instance = context.instance
    clients = instance.find_clients()
    with record_calls(with_results=()) if "pybullet" in sys.modules else contextlib.nullcontext(BulletCalls()) as calls:
        looks: list[_LoggedLook] = []
        for number, kind in enumerate(EPISODES):
            if kind == "zero" and not any(is_about_steps(name) for name in looks[-1].infos):
                break
            names = set(looks[-1].attributes) if looks else None
            looks += _play(instance, clients, calls, number, kind, names)
            if context.budget.is_over():
                break
    log = _join(instance, clients, looks)
    if log is None:
        raise NotJudged("what it observes has more than one size (RL101), or nothing was played")
    yield Fact("attributes", log)
    if any("/" in name or is_paid(name) for name in log.infos):
        yield Fact(WEIGHED_TERMS, find_weighed_terms(instance.env))
        yield Fact(ACTION_TERMS, find_action_terms(instance.env))


@dataclasses.dataclass
class _LoggedLook:
    episode: int
    attributes: dict[str, Numbers]
    observed: Numbers
    action: Numbers
    reward: float
    infos: dict[str, float]
    speeds: Numbers
    seconds: float


def _play(
    instance: Instance,
    clients: Sequence[int],
    calls: BulletCalls,
    number: int,
    kind: str,
    names: Collection[str] | None,
) -> Iterator[_LoggedLook]:
    """Play an episode; `names` are the attributes that changed in an earlier one."""
    watched: list[Attribute] = []
    engine = _Engine()
    longest = ZERO_STEPS if kind == "zero" else STEPS
    for moment in EpisodePlayer(instance, FIRST_SEED + number, kind, number=number, max_steps=longest):
        if moment.step == 0:
            every = read_attributes(instance.env).values()
            watched = [one for one in every if one.numbers.size and (names is None or one.name in names)]
            engine = _Engine.find(instance, clients)
        if not moment.is_readable:
            return
        yield _LoggedLook(
            number,
            {one.name: _read(one) for one in watched},
            flatten_floats(instance.leaves, moment.observation),
            flatten_action(instance.action_leaves, moment.action) if moment.step else np.zeros(0),
            moment.reward_number if moment.step else np.nan,
            dict(find_numbers(moment.info)) if isinstance(moment.info, dict) else {},
            engine.read_speeds(),
            engine.read_seconds(calls),
        )
        if moment.step == FEW_STEPS and names is None:
            after = [_read(one) for one in watched]
            watched = [
                one for one, now in zip(watched, after, strict=True) if not np.array_equal(one.numbers, now)
            ]  # reading all takes longer than many a step


def _read(attribute: Attribute) -> Numbers:
    try:
        return np.ravel(np.array(attribute.read(), np.float64))
    except (LookupError, TypeError, ValueError):
        return np.zeros(0)


@dataclasses.dataclass(frozen=True)
class _Engine:
    """The engine of an episode; looking for it takes longer than many a step."""

    model: Any = None
    data: Any = None
    bullet: World | None = None

    @classmethod
    def find(cls, instance: Instance, clients: Sequence[int]) -> "_Engine":
        if (simulation := find_mujoco(instance.env)) is not None:
            return cls(*simulation)
        return cls(bullet=read_world(clients[0]) if clients else None)

    @property
    def physics_s(self) -> float:
        """How long a step of the physics is [s]; NaN without an engine."""
        if self.model is not None:
            return float(self.model.opt.timestep)
        return np.nan if self.bullet is None else self._read_call_s() / max(1, self._read_parameter("numSubSteps"))

    def _read_call_s(self) -> float:
        return self._read_parameter("fixedTimeStep")

    def _read_parameter(self, name: str) -> float:
        assert self.bullet is not None
        return float(ClientCalls(self.bullet.client).getPhysicsEngineParameters()[name])

    def read_seconds(self, calls: BulletCalls) -> float:
        """Return how long was simulated [s]."""
        if self.data is not None:
            return float(self.data.time)
        return np.nan if self.bullet is None else calls.steps[self.bullet.client] * self._read_call_s()

    def read_speeds(self) -> Numbers:
        """Return the speeds of joints, shape (speeds,)."""
        if self.data is not None:
            return np.array(self.data.qvel)
        if self.bullet is None:
            return np.zeros(0)
        states = zip(self.bullet.bodies, read_states(self.bullet), strict=True)
        parts = [state[JOINTS + len(body.joints) :] for body, state in states if body.joints]
        return np.concatenate([np.zeros(0), *parts])


def _join(instance: Instance, clients: Sequence[int], looks: list[_LoggedLook]) -> AttributeLog | None:
    if len({(look.observed.shape, look.speeds.shape) for look in looks}) != 1:
        return None
    sizes = {name: {look.attributes[name].size for look in looks if name in look.attributes} for name in _names(looks)}
    always = [n for n in sizes if len(sizes[n]) == 1 and all(n in look.attributes for look in looks)]
    parts = [np.stack([look.attributes[name] for look in looks]) for name in always]
    values = np.hstack([np.zeros((len(looks), 0)), *parts])[:, :MOST_NUMBERS]
    names = [
        n if part.shape[1] == 1 else f"{n}[{i}]"
        for n, part in zip(always, parts, strict=True)
        for i in range(part.shape[1])
    ]
    width = max(look.action.size for look in looks)
    declared = find_declared_numbers(instance.env)
    repeats = find_repeats(instance.env, declared)
    info_names = {name: None for look in looks for name in look.infos}
    return AttributeLog(
        names=names[:MOST_NUMBERS],
        values=np.nan_to_num(values),
        observed=np.nan_to_num(np.stack([look.observed for look in looks]).astype(np.float64)),
        parts=list_float_parts(instance.leaves),
        actions=np.stack([np.resize(look.action, width) if look.action.size else np.zeros(width) for look in looks]),
        rewards=np.array([look.reward for look in looks]),
        infos={name: np.array([look.infos.get(name, np.nan) for look in looks]) for name in info_names},
        speeds=np.stack([look.speeds for look in looks]),
        seconds=np.array([look.seconds for look in looks]),
        physics_s=_Engine.find(instance, clients).physics_s,
        episodes=np.array([look.episode for look in looks]),
        declared={name: value for name, value in declared.items() if name not in names},
        literals=tuple(sorted(_find_literals(instance.env))),
        repeats=repeats,
        control_times=tuple(sorted(find_control_times(instance.env, declared, set(repeats.values())))),
    )


def _names(looks: list[_LoggedLook]) -> list[str]:
    return list(dict.fromkeys(name for look in looks for name in look.attributes))


def find_declared_numbers(env: Any) -> dict[str, float]:
    """Return the numbers of the author's object, of its classes, and of the modules of these, by name."""
    author = find_author(env)
    found: dict[str, float] = {}
    for cls in reversed(list_own_classes(author)):
        spaces = [vars(sys.modules.get(cls.__module__, cls)), vars(cls)]
        found |= {name: float(value) for space in spaces for name, value in space.items() if _is_number(value)}
    metadata = getattr(author, "metadata", None)
    if isinstance(metadata, dict):
        found |= {name: float(metadata[name]) for name in RATES if _is_number(metadata.get(name))}
    own = read_attributes(env)
    return found | {name: float(one.numbers[0]) for name, one in own.items() if _is_number(one.value)}


def find_weights(env: Any) -> set[float]:
    """Return the numbers by which a term of the reward may be multiplied: those declared, and those in the source."""
    return _find_literals(env) | {abs(value) for value in find_declared_numbers(env).values()}


def _is_number(value: Any) -> bool:
    return isinstance(value, NUMBERS) and not isinstance(value, bool | np.bool_) and fits_float(value)


def _find_literals(env: Any) -> set[float]:
    """Return the numbers that the source of its classes' modules has, without frequencies: the 240 of `1 / 240`."""
    found: set[float] = set()
    for tree in parse_sources(env).values():
        nodes = list(ast.walk(tree))
        frequencies = {id(node.right) for node in nodes if isinstance(node, ast.BinOp) and _is_fraction(node)}
        values = [node.value for node in nodes if isinstance(node, ast.Constant) and id(node) not in frequencies]
        found |= {abs(float(value)) for value in values if isinstance(value, int | float) and _is_number(value)}
    return found


def _is_fraction(node: ast.BinOp) -> bool:
    return isinstance(node.op, ast.Div) and isinstance(node.left, ast.Constant)
