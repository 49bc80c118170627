"""`TaskWorlds`: n worlds of a task, stepped together. A `Task` has one world, a `BatchTask` any number."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from rlctl.engine import MUJOCO, PYBULLET, Engine
from rlctl.errors import RecipeError, TaskError, UsageError, WorldFailed, check_name, in_world
from rlctl.task.batch import BatchTask
from rlctl.task.calls import Array, Flags, ManyWorldCalls, OneWorldCalls, TaskCalls
from rlctl.task.camera import locate
from rlctl.task.events import Event, EventSettings
from rlctl.task.events.acting import ActingEvents, Streams, seed_streams
from rlctl.task.events.event import Drawn
from rlctl.task.events.signals import Signals
from rlctl.task.joints import check_joints
from rlctl.task.mirror import ACTION, check_declaration
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.observation import (
    Observation,
    Observing,
    TeacherSight,
    View,
    check_names,
    compute_terms,
    is_finite,
)
from rlctl.task.privileged import CriticSight
from rlctl.task.pybullet.library import is_installed
from rlctl.task.pybullet.sim import PybulletSim
from rlctl.task.returned import WrongRow, reward_not_finite
from rlctl.task.sim import Sim
from rlctl.task.task import Task, check_definition, check_parameters
from rlctl.task.world_index import WorldIndex

RenderMode = Literal["human", "rgb_array"] | None

_MARKER_RADIUS, _MARKER_COLOR = 0.02, (0.1, 0.8, 0.3, 0.8)  # [m]; seen, and hides little; films add a ring


class WorldsStep(NamedTuple):
    """What a control step of k worlds gave."""

    observation: Observation  # (k, size), or a dict of (k, ...)
    reward: Array  # (k,)
    terminated: Flags  # (k,)
    truncated: Flags  # (k,)
    terms: Array  # raw reward terms in the order of the weights, (k, terms)
    success: Flags | None  # (k,)


class EpisodeTotals(NamedTuple):
    """What the running episode of a world has added up to."""

    reward: float
    terms: dict[str, float]  # sums of the weighted reward terms
    metrics: dict[str, float]  # mean per step of each reward term of weight 0, as the task returned it
    distance: float | None  # the term `distance` of the last step
    success: bool | None  # of the last step
    drawn: dict[str, Drawn]  # what the events drew last, by event


class TaskWorlds:
    """`count` worlds of a task; observations, actions and rewards have a row per world.

    An episode depends on its seed and actions only: not on how many worlds there are, nor on what they do.
    Engine and rendering are explained in `TaskEnv`.
    """

    def __init__(
        self,
        task: Task | BatchTask,
        count: int = 1,
        *,
        render_mode: RenderMode = None,
        reward_weights: Mapping[str, float] | None = None,
        events: EventSettings | None = None,
        sim: Engine = Engine(),  # noqa: B008 (it cannot change)
        visuals: bool = True,
        observing: Observing = Observing(),  # noqa: B008 (it cannot change)
    ) -> None:
        check_parameters(type(task))
        check_definition(task)
        self.task, self.count = task, count
        self.name = type(task).__name__
        self._is_batch = isinstance(task, BatchTask)
        self.calls: TaskCalls
        if isinstance(task, BatchTask):
            self.calls = ManyWorldCalls(task, count)
            is_flat_box = task.observation_layout == "flat" and isinstance(task.action_space, spaces.Box)
            if count > 1 and not is_flat_box:
                raise TaskError(f"{self.name}: a BatchTask has flat observations and actions in a Box")
        else:
            self.calls = OneWorldCalls(task)
        self.weights = _merge_weights(task, reward_weights or {})
        self._weight_values = np.array([*self.weights.values()])
        self.max_steps, self.has_success = task.max_steps, self.calls.has_success
        self._limits = np.full(count, self.max_steps)  # steps after which each world's episode is truncated
        self.compute_reward = None
        """The task's method for other goals, where it defines one; see `Task.compute_reward`."""
        if isinstance(task, Task) and type(task).compute_reward is not Task.compute_reward:
            self.compute_reward = task.compute_reward
        # A space holds a random generator: one on the class would be shared by every instance.
        self.action_space = copy.deepcopy(task.action_space)
        self._is_box = isinstance(self.action_space, spaces.Box)
        if isinstance(self.action_space, spaces.Box):
            box = self.action_space
            self._low, self._high = box.low[None], box.high[None]
            self._zero_actions = np.zeros(count * box.low.size, box.dtype)
        self.level = 1.0
        """How hard the next episodes are, where `reset` is not told."""
        self._all: WorldIndex = np.arange(count)
        self.step_of = np.zeros(count, np.int64)
        """Steps since the start of each world's episode."""
        self._gained = np.zeros((count, 1 + len(self.weights)))  # reward and raw terms of the episodes so far
        self._steps_left = 0  # at least so many steps are left to the time limit
        self._no_flags, self._zeros, self._ones = np.zeros(count, bool), np.zeros(count), np.ones(count, np.int64)
        self._last_terms, self._last_success = np.zeros((count, len(self.weights))), np.zeros(count, bool)
        self._streams: list[Streams] = [{} for _ in range(count)]
        self._levels = np.ones(count)
        self.drawn: list[dict[str, Drawn]] = [{} for _ in range(count)]
        """Per world the values that the events of this episode drew, the last ones of those at an interval."""
        self.drawn_now: dict[str, Drawn] = {}
        """What the events at an interval drew in the last step, in its last world."""
        self.measured: dict[str, Any] = {}
        """What the last observation's terms were computed from, by the name of the term; with a leading axis."""
        self.critic: CriticSight | None = None  # what only a critic sees, after `show_critic`
        self._critic_rows = np.zeros((count, 0), np.float32)
        self.teacher: TeacherSight | None = None  # after `show_teacher`
        self._markers: dict[str, int] = {}
        self.after_physics: Callable[[], None] | None = None
        """Called after the physics of each step, before anything is judged: it may place bodies."""
        self.sim: Any = _make_sim(task, count, sim, render_mode, visuals=visuals)
        self.sim.cameras = task.cameras
        try:
            self._set_up(events or EventSettings(), observing, has_markers=render_mode is not None)
        except BaseException:
            self.sim.close()
            raise

    def _set_up(self, settings: EventSettings, observing: Observing, *, has_markers: bool) -> None:
        """Build the world, and try everything once to find mistakes before the first episode."""
        self.events = settings.apply(self.task.events)
        self._acting = ActingEvents(self.events, self.task.control_dt)
        self._build()
        one, first_world = self.sim_of(0), np.zeros(1, np.int64)
        for camera in self.task.cameras.values():
            locate(camera, one.bodies)
        drawn = self._acting.try_once(["reset"], one)
        self.calls.reset([np.random.default_rng(0)], first_world)
        drawn |= self._acting.try_once(["start", "interval"], one)
        observed = self._compute_terms(self.calls.observe())
        self.calls.check_kept("reset")
        self._first = {name: value[0] for name, value in observed.items()}
        cameras = self.task.cameras.items()
        self._pictures = {name: np.zeros(c.shape, np.uint8) for name, c in cameras if name in observing.names}
        self._signals = self._make_signals(self.events)
        drawn |= self._signals.try_once({**self._first, **self._pictures})
        privileged = self.calls.privileged()
        if isinstance(privileged, dict):
            privileged = {name: value[0] for name, value in privileged.items()}
        self._privileged_examples, self._drawn_examples = privileged, drawn
        quantities = [name for term in self.task.observation_terms.values() for name in term.inputs]
        check_joints(self.name, self.task.describe_joints(), self.action_space, [*self._first, *quantities])
        # A task knows its markers after a reset; they are added to the world as it was built.
        markers = list(self.calls.markers()) if has_markers else []
        if self.events or has_markers or self.count > 1:
            self.sim.restore()
        if markers:
            self._add_markers(markers)
        check_names(self.task, self._first)
        self.view = self._make_view(observing)
        sizes = {name: int(np.size(value)) for name, value in self._first.items()}
        sizes[ACTION] = math.prod(self.action_space.shape or ())
        check_declaration(self.name, self.task.mirror, sizes, self._privileged_examples)

    def _build(self) -> None:
        self.calls.build(self.sim)
        self.sim.save()

    def _add_markers(self, names: Sequence[str]) -> None:
        one = self.sim_of(0)
        self._markers = {
            name: one.add_marker((0, 0, -10), radius=_MARKER_RADIUS, color=_MARKER_COLOR) for name in names
        }
        self.sim.save()

    def sim_of(self, world: int) -> Sim:
        """Return the simulation of one world, whose arrays have no leading axis."""
        return self.calls.sim_of(self.sim, world)

    def _make_view(self, observing: Observing) -> View:
        return View(self.task, self.count, observing, self._first, self._privileged_examples)

    def _make_signals(self, events: Mapping[str, Any]) -> Signals:
        first = {**self._first, **self._pictures}
        return Signals(self.count, events, first, self.action_space, self.task.observation_bounds)

    def show_teacher(self, observing: Observing, events: EventSettings) -> TeacherSight:
        """Observe for a teacher with its own `events` too, from the next reset on; `RecipeError` for wrong names."""
        disturbed = self._make_signals(events.apply(self.task.events)).disturbed
        self.teacher = TeacherSight(self._make_view(observing), self.count, disturbed)
        return self.teacher

    def show_critic(self, *, task: bool, events: bool) -> None:
        """Let `observe_privileged` return what the task names, and the values of events, from the next reset on.

        Raises `RecipeError` if there is neither.
        """
        examples = self._privileged_examples, self._drawn_examples
        self.critic = CriticSight.of(self.name, *examples, task=task, events=events)
        self._critic_rows = np.zeros((self.count, self.critic.size), np.float32)

    def set_events(self, events: EventSettings, added: Mapping[str, Event] | None = None) -> None:
        """Let only the events of `events` and the `added` ones act; call `reset` afterwards.

        The worlds are not built again. Raises `RecipeError` for invalid events.
        """
        self.events = events.apply({**self.task.events, **(added or {})})
        self._acting = ActingEvents(self.events, self.task.control_dt)
        self._signals = self._make_signals(self.events)

    def reset(
        self,
        worlds: WorldIndex,
        seeds: Sequence[int],
        levels: Array | None = None,
        generators: Sequence[np.random.Generator] | None = None,
    ) -> Observation:
        """Begin the episodes of `seeds` in `worlds`; return their first observations, shape (k, size).

        `levels`, shape (k,), is how hard they are; `generators` replace those of the seeds in the task's reset. Equal
        seeds give equal episodes, whatever was simulated before.
        """
        if self._is_all(worlds):
            worlds = self._all
        if self.task.fast_reset:
            self.calls.restore(self.sim, worlds)
        else:
            self.sim.clear()
            self._build()
            if self._markers:
                self._add_markers(list(self._markers))
        self.step_of[worlds] = 0
        self._gained[worlds] = 0.0
        self._count_steps_left()
        if levels is None:
            levels = np.full(len(worlds), self.level)
        self._levels[worlds] = levels
        self.calls.set_level(levels, worlds)
        self._critic_rows[worlds] = 0.0  # what is of an event that has not acted yet
        if generators is None:
            generators = [np_random(int(seed))[0] for seed in seeds]
        listed = worlds.tolist()
        for world, seed in zip(listed, seeds, strict=True):
            self.drawn[world] = {}
            if self.events:
                self._streams[world] = seed_streams(self.events, int(seed))
                self._run_events("reset", world)
        self.calls.reset(generators, worlds)
        for world in listed if self.events else ():
            self._run_events("start", world)
            self._signals.begin(world, self._streams[world], float(self._levels[world]))
        self.view.begin(worlds)
        if self.teacher is not None:
            self.teacher.view.begin(worlds)
        with self.calls.leave_others(self.sim, worlds):
            observation = self._observe(worlds)
            self.calls.check_kept("reset")
        for world in listed if self.events else ():
            self._note(world, self._signals.drawn[world])
        return observation

    def shorten(self, worlds: WorldIndex, limits: NDArray[np.int64]) -> None:
        """Truncate the next episodes of some worlds after so many steps, or after `max_steps` where it is 0."""
        self._limits[worlds] = np.where(limits > 0, limits, self.max_steps)

    def _run_events(self, when: Literal["reset", "start"], world: int) -> None:
        with in_world(world):
            drawn = self._acting.run(when, self.sim_of(world), self._streams[world], float(self._levels[world]))
        self._note(world, drawn)

    def _note(self, world: int, drawn: Mapping[str, Drawn]) -> None:
        """Keep what events drew, and let the critic see it."""
        self.drawn[world].update(drawn)
        if self.critic is not None:
            with in_world(world):
                self.critic.write_events(self._critic_rows[world], drawn)

    def observe_privileged(self, worlds: WorldIndex) -> NDArray[np.float32]:
        """Return what only the critic sees now in some worlds, shape (k, size); call `show_critic` once before."""
        assert self.critic is not None
        with self.calls.leave_others(self.sim, worlds):
            self.critic.write_task(self._critic_rows, self.critic.read_task(self.calls))
        chosen: NDArray[np.float32] = self._critic_rows[worlds]
        bad = ~np.isfinite(chosen.sum(axis=1))
        if bad.any():
            row = int(bad.argmax())
            self._fail(worlds[row], f"privileged {self.critic.find_fault(chosen[row])!r} is not finite at step {{}}")
        return chosen

    def step(self, action: Any, worlds: WorldIndex | None = None) -> WorldsStep:
        """Advance all worlds, or some, by a control step; `action` has a row for each of them, shape (k, ...)."""
        self._steps_left -= 1  # here, so that it is right after a step that fails
        if worlds is None or self._is_all(worlds):
            np.add(self.step_of, self._ones, out=self.step_of)
            return self._step(self._check_action(action, self._all), self._all)
        self.step_of[worlds] += 1
        chosen = self._check_action(action, worlds)
        with self.calls.leave_others(self.sim, worlds):
            return self._step(chosen, worlds)

    def _is_all(self, worlds: WorldIndex) -> bool:
        return self.count == 1 or (len(worlds) == self.count and bool((worlds == self._all).all()))

    def _step(self, chosen: Any, worlds: WorldIndex) -> WorldsStep:
        """Take a step; `chosen` and what is returned have rows of `worlds`, names in `_of_all` those of all worlds."""
        is_all, calls = worlds is self._all, self.calls
        acted = self._signals.act(chosen, worlds)
        if is_all:
            chosen_of_all = chosen
            calls.act(acted)
            self.sim.step()
        else:
            chosen_of_all = self._spread(chosen, worlds)
            calls.act(self._spread(acted, worlds))
            self.sim.step(worlds)
        if self.after_physics is not None:
            self.after_physics()
        terminated_of_all = calls.is_terminated()
        gained_of_all = self.rewards(chosen_of_all)
        if is_all:
            terminated, gained = terminated_of_all, gained_of_all
            np.add(self._gained, gained, out=self._gained)
        else:
            terminated, gained = terminated_of_all[worlds], gained_of_all[worlds]
            self._gained[worlds] += gained
        reward, terms = gained[:, 0], gained[:, 1:]
        truncated = self._find_truncated(terminated, worlds)
        if self._is_batch and not is_finite(reward, self._zeros):
            self._check_reward(reward, terms, worlds)
        if self._acting.periods:
            self._run_due(worlds)
        success = None
        if self.has_success:
            success_of_all = calls.is_success()
            if is_all:
                success = self._last_success = success_of_all
            else:
                success = success_of_all[worlds]
                self._last_success[worlds] = success
        observation = self._observe(worlds)
        calls.check_kept("a step")
        if is_all:
            self._last_terms = terms
        else:
            self._last_terms[worlds] = terms
        return WorldsStep(observation, reward, terminated, truncated, terms, success)

    def rewards(self, action: Any) -> Array:
        """Return the reward and the raw terms of all worlds, shape (n, 1 + terms); see `TaskCalls.rewards`."""
        try:
            return self.calls.rewards(action, self.weights)
        except WrongRow as wrong:
            self._fail(wrong.row, str(wrong))

    def _find_truncated(self, terminated: Flags, worlds: WorldIndex) -> Flags:
        late = self._find_late(terminated, worlds)
        if not self.calls.has_end:
            return late
        return late | (self.calls.is_truncated()[worlds] & ~terminated)

    def _find_late(self, terminated: Flags, worlds: WorldIndex) -> Flags:
        if self._steps_left > 0:  # no world can be at the time limit
            return self._no_flags if len(worlds) == self.count else self._no_flags[: len(worlds)]
        self._count_steps_left()
        return (self.step_of[worlds] >= self._limits[worlds]) & ~terminated

    def _count_steps_left(self) -> None:
        self._steps_left = int((self._limits - self.step_of).min())

    def _spread(self, values: Any, worlds: WorldIndex) -> Any:
        """Return values of some worlds as rows of all worlds; the others have zeros."""
        full = np.zeros((self.count, *values.shape[1:]), values.dtype)
        full[worlds] = values
        return full

    def _check_action(self, action: Any, worlds: WorldIndex) -> Any:
        if not self._is_box:
            for row, one in zip(worlds, action, strict=True):
                if not self.action_space.contains(one):
                    raise WorldFailed(f"{self.name}: action {one!r} is not in {self.action_space}", int(row))
            return action
        low, high = self._low, self._high
        given = np.asarray(action, low.dtype)
        if given.shape != (len(worlds), *low.shape[1:]):
            if self.count == 1:
                raise TaskError(f"{self.name}: action of shape {given.shape[1:]}, the space has {low.shape[1:]}")
            raise TaskError(f"{self.name}: actions of shape {given.shape}, expected {(len(worlds), *low.shape[1:])}")
        clipped = np.minimum(np.maximum(given, low), high)
        if not is_finite(clipped, self._zero_actions):
            bad = ~np.isfinite(clipped).reshape(len(worlds), -1).all(axis=1)
            self._fail(worlds[bad.argmax()], "action is not finite at step {}")
        return clipped

    def _fail(self, world: Any, message: str) -> NoReturn:
        before, place, after = message.rpartition("{}")  # of the step; a value before it may be an empty dict
        assert place
        raise WorldFailed(f"{self.name}: {before}{self.step_of[world]}{after}", int(world))

    def _check_reward(self, reward: Array, terms: Array, worlds: WorldIndex) -> None:
        bad = ~np.isfinite(reward)
        if bad.any():
            row = int(bad.argmax())
            weighted = dict(zip(self.weights, (terms[row] * self._weight_values).tolist(), strict=True))
            self._fail(worlds[row], str(reward_not_finite(weighted, float(reward[row]))))

    def totals(self, world: int) -> EpisodeTotals:
        """Return what the running episode of a world has added up to."""
        names, steps = list(self.weights), max(int(self.step_of[world]), 1)
        sums = self._gained[world, 1:]
        last = dict(zip(names, self._last_terms[world].tolist(), strict=True))
        distance = last.get("distance")
        metrics = {name: float(sums[index]) / steps for index, name in enumerate(names) if not self.weights[name]}
        return EpisodeTotals(
            reward=float(self._gained[world, 0]),
            terms=dict(zip(names, (sums * self._weight_values).tolist(), strict=True)),
            metrics=metrics,
            distance=distance,
            success=bool(self._last_success[world]) if self.has_success else None,
            drawn=dict(self.drawn[world]),
        )

    def next_level(self, world: int) -> float | None:
        """Return the level of the episode after the one that has ended in a world; None: it follows success."""
        return self.calls.next_level(world)

    def deepest_contact(self, world: int) -> float:
        """Return how far two bodies of a world overlap at most now [m]."""
        return self.sim_of(world).deepest_contact

    def teacher_sees(self, worlds: WorldIndex) -> Any:
        """Return what the teacher sees now of some worlds, shape (k, ...)."""
        assert self.teacher is not None
        seen = self.teacher.seen
        if isinstance(seen, dict):
            return {name: rows[worlds] for name, rows in seen.items()}
        return seen[worlds]

    @property
    def teacher_sizes(self) -> Mapping[str, int]:
        """Elements per name of what the teacher sees."""
        assert self.teacher is not None
        return self.teacher.view.sizes

    @property
    def teacher_space(self) -> spaces.Space[Any]:
        """The space of what the teacher sees."""
        assert self.teacher is not None
        space: spaces.Space[Any] = self.teacher.view.space
        return space

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """The space of the observation of one world."""
        space: spaces.Space[Any] = self.view.space
        return space

    def _run_due(self, worlds: WorldIndex) -> None:
        self.drawn_now = {}
        due = np.any([self.step_of[worlds] % period == 0 for period in set(self._acting.periods)], axis=0)
        for world in worlds[due].tolist():
            step, level = int(self.step_of[world]), float(self._levels[world])
            with in_world(world):
                drawn = self._acting.run_due(step, self.sim_of(world), self._streams[world], level)
            self.drawn_now = drawn
            self._note(world, drawn)

    def _compute_terms(self, observed: dict[str, Any]) -> dict[str, Any]:
        terms = self.task.observation_terms
        if not terms:
            return observed
        self.measured = {name: observed[name] for name in terms if name in observed}
        return compute_terms(self.name, terms, observed)

    def measured_of(self, world: int) -> dict[str, Any]:
        """Return what the last observation's terms of a world were computed from, without the leading axis."""
        return {name: take_row(value, world) for name, value in self.measured.items()}

    def observe_exactly(self) -> dict[str, Any]:
        """Return what the task observes now without noise and delay, its terms computed; each of shape (n, ...)."""
        return self._compute_terms(self.calls.observe())

    def _observe(self, worlds: WorldIndex) -> Observation:
        exact = self._compute_terms(self.calls.observe())
        if worlds is not self._all:
            exact = {name: value[worlds] for name, value in exact.items()}
        exact |= {name: self.sim.take_pictures(name, worlds) for name in self._seen_cameras}
        seen = self._signals.observe(exact, worlds)
        try:
            if self.teacher is not None:
                shown = {**exact, **self._read_privileged(self.teacher.view, worlds)}
                self.teacher.look(shown, seen, worlds)
            if self.view.privileged:
                seen = {**seen, **self._read_privileged(self.view, worlds)}
            return self.view.assemble(seen, worlds)
        except WrongRow as wrong:
            self._fail(worlds[wrong.row], str(wrong))

    @property
    def _seen_cameras(self) -> list[str]:
        """The cameras by which the policy or the teacher sees."""
        if self.teacher is None:
            return self.view.cameras
        return list(dict.fromkeys([*self.view.cameras, *self.teacher.view.cameras]))

    def _read_privileged(self, view: View, worlds: WorldIndex) -> dict[str, Any]:
        if not view.privileged:
            return {}
        parts = self.calls.privileged()
        return {name: parts[name][worlds] for name in view.privileged if name in parts}

    def move_markers(self) -> None:
        """Move the drawn markers to their current positions in world 0."""
        positions = self.calls.markers()
        for name, marker in self._markers.items():
            self.sim_of(0).move_marker(marker, positions[name][0])

    def close(self) -> None:
        """End the simulation."""
        self.sim.close()


def take_row(rows: Any, row: int = 0) -> Any:
    """Return a row of an array, or of the arrays of a dict or a tuple."""
    if isinstance(rows, dict):
        return {name: values[row] for name, values in rows.items()}
    if isinstance(rows, tuple):
        return tuple(values[row] for values in rows)
    return rows[row]


def choose_engine(task: type) -> Engine:
    """Return PyBullet if it is installed, for a `BatchTask` and otherwise MuJoCo."""
    needs_mujoco = issubclass(task, BatchTask) or not is_installed()
    return MUJOCO if needs_mujoco else PYBULLET


def _make_sim(
    task: Task | BatchTask, worlds: int, asked: Engine, render_mode: RenderMode, *, visuals: bool
) -> PybulletSim | MujocoSim:
    engine, iterations = asked or choose_engine(type(task)), task.solver_iterations
    dt, substeps, is_batch = task.control_dt, task.substeps, isinstance(task, BatchTask)
    if engine.name != "mujoco" and is_batch:
        raise UsageError(f"{type(task).__name__} simulates its worlds in MuJoCo: sim: mujoco, or --sim mujoco")
    if engine.name != "mujoco":
        gui = render_mode == "human"
        return PybulletSim(control_dt=dt, substeps=substeps, solver_iterations=iterations, gui=gui)
    if render_mode == "human" and not is_batch:
        raise UsageError("sim mujoco opens no window; record the episode to see it in 3-D")
    return MujocoSim(
        control_dt=dt,
        substeps=substeps,
        solref=engine.contact_time,
        iterations=iterations,
        worlds=worlds if is_batch else None,
        visuals=visuals,
    )


def _merge_weights(task: Task | BatchTask, changes: Mapping[str, float]) -> dict[str, float]:
    weights = {name: float(weight) for name, weight in task.reward_weights.items()}
    for name, weight in changes.items():
        check_name(name, weights, f"reward_weights: {type(task).__name__} has no term", RecipeError)
        weights[name] = float(weight)
    return weights
