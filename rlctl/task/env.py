"""`TaskEnv`: the Gymnasium environment around a task."""

import copy
import functools
import math
import operator
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from rlctl.errors import RecipeError, TaskError, UsageError, check_name, short_repr
from rlctl.task.batch import BatchTask, OneWorld, as_single
from rlctl.task.events import Event, EventSettings
from rlctl.task.events.acting import ActingEvents, Signals, Streams, seed_streams
from rlctl.task.events.event import Drawn
from rlctl.task.joints import check_joints
from rlctl.task.mirror import ACTION, check_declaration
from rlctl.task.mujoco.sim import MujocoSim, read_solref
from rlctl.task.observation import Observation, Observing, TeacherSight, View, check_names, compute_terms
from rlctl.task.privileged import PrivilegedFormat
from rlctl.task.pybullet.library import is_installed
from rlctl.task.pybullet.sim import PybulletSim
from rlctl.task.returned import not_a_number, not_by_name, term_mismatch
from rlctl.task.sim import Sim
from rlctl.task.task import Task, check_definition, check_parameters


class TaskEnv(gymnasium.Env[Observation, Any]):
    """Steps a `Task`: act, physics, terminated, rewards, interval events, observe.

    `info` holds `reward_terms` (weighted; they add up to the reward), `metrics` (every raw term), `is_success`
    where the task defines it, and, in steps with events, `events` (the drawn values). `sim` is the engine:
    `pybullet`, `mujoco`, `mujoco:SOLREF`; by default that of `choose_engine`. Without `visuals` MuJoCo loads visual
    shapes only when the task takes its first picture. `observing` is what the policy sees.
    """

    def __init__(
        self,
        task: Task | BatchTask,
        *,
        render_mode: Literal["human", "rgb_array"] | None = None,
        reward_weights: Mapping[str, float] | None = None,
        events: EventSettings | None = None,
        sim: str = "",
        visuals: bool = True,
        observing: Observing = Observing(),  # noqa: B008 (it cannot change)
    ) -> None:
        check_parameters(type(task))
        self.task = task = as_single(task)
        check_definition(task)
        self.name = type(task).__name__
        # gymnasium.Env has one dict for all environments.
        self.metadata = {"render_modes": ["human", "rgb_array"], "render_fps": round(1 / task.control_dt)}
        if render_mode not in (None, "human", "rgb_array"):
            raise RecipeError(f"render_mode {render_mode!r} is not one of: human, rgb_array")
        self._spec: EnvSpec | None = None
        self.render_mode = render_mode
        self.reward_weights = _merge_weights(task, reward_weights or {})
        self.events = (events or EventSettings()).apply(task.events)
        self.has_success = type(task).is_success is not Task.is_success
        if type(task).compute_reward is not Task.compute_reward:
            # Only then: code that relabels goals checks whether an environment has this method.
            self.compute_reward = task.compute_reward
        self.max_steps = task.max_steps
        # A space holds a random generator: one on the class would be shared by every instance.
        self.action_space = copy.deepcopy(task.action_space)
        self._acting = ActingEvents(self.events, task.control_dt)
        self.level = self._episode_level = 1.0
        self.measured: dict[str, Any] = {}
        """What the last observation's terms were computed from, by the name of the term."""
        self.sim = _make_world(task, sim, render_mode, visuals=visuals)
        self._step = 0
        self._running = self._closed = False
        self._streams: Streams = {}
        self._markers: dict[str, int] = {}
        self.drawn: dict[str, Drawn] = {}
        """Values that the events of this episode drew, the last ones of those at an interval."""
        self.privileged: PrivilegedFormat | None = None  # what only a critic sees, after `show_critic`
        try:
            self._build()
            drawn = self._acting.try_once(["reset"], self.sim)
            task.reset(np.random.default_rng(0))
            drawn |= self._acting.try_once(["start", "interval"], self.sim)
            observed = task.observe()
            if not isinstance(observed, dict) or not observed:
                raise not_by_name(self.name, "observe", observed)
            self._first = first = self.compute_terms(observed)
            self._signals = Signals(self.events, first, self.action_space, task.observation_bounds)
            self._signals.try_once()
            self._examples = task.privileged(), drawn | self._signals.drawn
            quantities = [name for term in task.observation_terms.values() for name in term.inputs]
            check_joints(self.name, task.describe_joints(), self.action_space, [*first, *quantities])
            # A task knows its markers after a reset; they are added to the world as it was built.
            markers = list(task.markers()) if render_mode is not None else []
            if self.events or render_mode is not None:
                self.sim.restore()
            if render_mode is not None:
                self._add_markers(markers)
        except BaseException:
            self.sim.close()
            raise
        check_names(task, first)
        self.view = self._make_view(observing)
        self.observation_sizes, self.observation_space = self.view.format.sizes, self.view.format.space
        self.teacher: TeacherSight | None = None  # after `show_teacher`
        sizes = {name: int(np.size(value)) for name, value in first.items()}
        sizes[ACTION] = math.prod(self.action_space.shape or ())
        check_declaration(self.name, task.mirror, sizes, self._examples[0])

    def _make_view(self, observing: Observing) -> View:
        return View(self.task, observing, self._first, self._examples[0])

    def show_teacher(self, observing: Observing, events: EventSettings) -> TeacherSight:
        """Observe for a teacher with its own `events` too, from the next reset on; `RecipeError` for wrong names."""
        signals = Signals(events.apply(self.task.events), self._first, self.action_space, self.task.observation_bounds)
        self.teacher = TeacherSight(
            self._make_view(observing), {name for names in signals.of.values() for name in names}
        )
        return self.teacher

    def set_level(self, level: float) -> None:
        """Set the level of the task, and of ranges written `{from: ..., to: ...}`, from 0 to 1, for the next resets."""
        self.level = float(level)

    def show_critic(self, *, task: bool, events: bool) -> None:
        """Let `observe_privileged` return what the task names, and the values of events, from the next reset on.

        Raises `RecipeError` if there is neither.
        """
        self.privileged = PrivilegedFormat.of(self.name, *self._examples, task=task, events=events)

    def observe_privileged(self) -> NDArray[np.float32]:
        """Return what only the critic sees now, shape (size,); call `show_critic` once before."""
        assert self.privileged is not None
        return self.privileged.observe(self.task, self.drawn, self._step)

    def set_events(self, events: EventSettings, added: Mapping[str, Event] | None = None) -> None:
        """Let only the events of `events` and the `added` ones act; call `reset` afterwards.

        The world is not built again. Raises `RecipeError` for invalid events.
        """
        self.events = events.apply({**self.task.events, **(added or {})})
        self._acting = ActingEvents(self.events, self.task.control_dt)
        self._signals = Signals(self.events, self._first, self.action_space, self.task.observation_bounds)
        self._streams = {}
        self._running = False

    def _build(self) -> None:
        self.task.sim = self.sim
        self.task.build(self.sim)
        self.sim.save()

    def _add_markers(self, names: Iterable[str]) -> None:
        self._markers = {
            name: self.sim.add_marker((0, 0, -10), radius=0.03, color=(0.1, 0.8, 0.3, 0.8)) for name in names
        }
        self.sim.save()

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's spec, from which libraries read the id and the time limit; None unless `make` has set it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and spec.max_episode_steps is None:
            spec = copy.deepcopy(spec)
            spec.max_episode_steps = self.max_steps
        self._spec = spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; equal seeds give equal episodes, whatever was simulated before."""
        super().reset(seed=seed)
        if self._closed:
            raise TaskError(f"{self.name}: reset() after close(); make a new environment")
        if self.task.fast_reset:
            self.sim.restore()
        else:
            self.sim.clear()
            self._build()
            if self._markers:
                self._add_markers(list(self._markers))
        self._episode_level = self.task.level = self.level
        if self.events and (seed is not None or not self._streams):
            base = int(self.np_random.integers(2**63)) if seed is None else seed
            self._streams = seed_streams(self.events, base)
        drawn = self._acting.run("reset", self.sim, self._streams, self.level)
        self.task.reset(self.np_random)
        drawn |= self._acting.run("start", self.sim, self._streams, self.level)
        self._signals.begin(self._streams, self.level)
        self.view.begin()
        if self.teacher is not None:
            self.teacher.view.begin()
        self._step = 0
        self._running = True
        observation = self._observe()
        drawn |= self._signals.drawn
        self.drawn = dict(drawn)
        info: dict[str, Any] = {"events": drawn} if drawn else {}
        if self.render_mode == "human":
            self.move_markers()
        return observation, info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance one control step of `control_dt` seconds."""
        if not self._running:
            raise TaskError(f"{self.name}: step() before reset(), after the episode's end, or after close()")
        task = self.task
        action = self._check_action(action)
        task.act(self._signals.act(action))
        self.sim.step()
        self._step += 1
        terminated = self._read_flag("is_terminated")
        truncated = not terminated and self._step >= self.max_steps
        raw = task.rewards(action)
        if not isinstance(raw, dict):
            raise not_by_name(self.name, "rewards", raw)
        weights = self.reward_weights
        if raw.keys() != weights.keys():
            raise term_mismatch(self.name, raw, weights)
        try:
            terms = {name: weight * raw[name] for name, weight in weights.items()}
            # `sum` rounds differently since Python 3.12; a batch of worlds adds in this order.
            reward = float(functools.reduce(operator.add, terms.values(), 0.0))
        except (TypeError, ValueError):
            raise not_a_number(self.name, raw, self._step) from None
        if not math.isfinite(reward):
            bad = next((name for name, term in terms.items() if not math.isfinite(term)), "sum")
            raise TaskError(f"{self.name}: reward term {bad!r} is {terms.get(bad, reward)} at step {self._step}")
        info: dict[str, Any] = {"reward_terms": terms, "metrics": {name: raw[name] for name in weights}}
        if self._acting.periods:
            drawn = self._acting.run_due(self._step, self.sim, self._streams, self._episode_level)
            info.update({"events": drawn} if drawn else {})
            self.drawn.update(drawn)
        if self.has_success:
            info["is_success"] = self._read_flag("is_success")
        self._running = not (terminated or truncated)
        observation = self._observe()
        if self.render_mode == "human":
            self.move_markers()
        return observation, reward, terminated, truncated, info

    def _read_flag(self, method: str) -> bool:
        flag = getattr(self.task, method)()
        try:
            is_flag = flag in (False, True)
        except ValueError:  # an array
            is_flag = False
        if not is_flag:
            raise TaskError(f"{self.name}: {method}() returned {short_repr(flag)}, not True or False")
        return bool(flag)

    def _check_action(self, action: Any) -> Any:
        space = self.action_space
        if not isinstance(space, spaces.Box):
            if not space.contains(action):
                raise TaskError(f"{self.name}: action {action!r} is not in {space}")
            return action
        action = np.asarray(action, dtype=space.dtype)
        if action.shape != space.shape:
            raise TaskError(f"{self.name}: action of shape {action.shape}, the space has {space.shape}")
        action = np.minimum(np.maximum(action, space.low), space.high)
        if not math.isfinite(sum(action.ravel().tolist())):  # faster than any function of arrays
            raise TaskError(f"{self.name}: action is not finite at step {self._step + 1}")
        return action

    def _observe(self) -> Observation:
        exact = self.compute_terms(self.task.observe())
        seen = self._signals.observe(exact)
        if self.teacher is not None:
            self.teacher.look({**exact, **self._read_privileged(self.teacher.view)}, seen, self._step)
        if self.view.privileged:
            seen = {**seen, **self._read_privileged(self.view)}
        return self.view.assemble(seen, self._step)

    def _read_privileged(self, view: View) -> dict[str, Any]:
        parts = self.task.privileged() if view.privileged else {}
        return {name: parts[name] for name in view.privileged if name in parts}

    def compute_terms(self, observed: Any) -> Any:
        """Return what `Task.observe` returned with its terms computed, as the policy sees it without noise."""
        terms = self.task.observation_terms
        if not terms or not isinstance(observed, dict):
            return observed
        self.measured = {name: observed[name] for name in terms if name in observed}
        return compute_terms(self.name, terms, observed)

    def move_markers(self) -> None:
        """Move the drawn markers to their current positions in the task."""
        positions = self.task.markers()
        for name, marker in self._markers.items():
            self.sim.move_marker(marker, positions[name])

    def render(self) -> Any:
        """Return an RGB image of shape (240, 320, 3) in `rgb_array` mode; None in `human` mode, which has a window."""
        if self.render_mode != "rgb_array":
            return None
        self.move_markers()
        return self.sim.render()

    def close(self) -> None:
        """End the simulation."""
        self._running, self._closed = False, True
        self.sim.close()


def choose_engine(task: type) -> str:
    """Return `pybullet` if it is installed, for a `BatchTask` and otherwise `mujoco`."""
    return "mujoco" if issubclass(task, BatchTask | OneWorld) or not is_installed() else "pybullet"


def _make_world(task: Task, sim: str, render_mode: str | None, *, visuals: bool) -> Sim:
    solref, iterations = read_solref(sim or choose_engine(type(task))), task.solver_iterations
    dt, substeps = task.control_dt, task.substeps
    if isinstance(task, OneWorld):
        if solref is None:
            raise UsageError(f"{type(task).__name__} simulates its worlds in MuJoCo: sim: mujoco, or --sim mujoco")
        many = MujocoSim(
            control_dt=dt, substeps=substeps, solref=solref, iterations=iterations, worlds=1, visuals=visuals
        )
        return many.one(0)
    if solref is None:
        gui = render_mode == "human"
        return PybulletSim(control_dt=dt, substeps=substeps, solver_iterations=iterations, gui=gui)
    if render_mode == "human":
        raise UsageError("sim mujoco opens no window; record the episode to see it in 3-D")
    return MujocoSim(control_dt=dt, substeps=substeps, solref=solref, iterations=iterations, visuals=visuals)


def _merge_weights(task: Task, changes: Mapping[str, float]) -> dict[str, float]:
    weights = {name: float(weight) for name, weight in task.reward_weights.items()}
    for name, weight in changes.items():
        check_name(name, weights, f"reward_weights: {type(task).__name__} has no term", RecipeError)
        weights[name] = float(weight)
    return weights
