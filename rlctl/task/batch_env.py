"""`BatchEnv`: n worlds of a `BatchTask`, stepped together; the same episodes as of one world at a time."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from rlctl.errors import TaskError, WorldFailed, in_world, short_repr
from rlctl.task.batch import BatchTask, WorldRngs, read_rows
from rlctl.task.batch_view import BatchView, RowFault
from rlctl.task.env import TaskEnv
from rlctl.task.events.acting import ActingEvents, Streams, seed_streams
from rlctl.task.events.batch_signals import BatchSignals
from rlctl.task.events.event import Drawn
from rlctl.task.mujoco.sim import MujocoSim, read_solref
from rlctl.task.observation import View, compute_terms

Array = NDArray[np.float64]
Worlds = NDArray[np.int64]


class BatchStep(NamedTuple):
    """What a step of k worlds gave."""

    observation: NDArray[np.float32]  # (k, size)
    reward: Array  # (k,)
    terminated: NDArray[np.bool_]  # (k,)
    truncated: NDArray[np.bool_]  # (k,)
    terms: Array  # raw reward terms, (k, terms)
    success: NDArray[np.bool_] | None  # (k,)


class BatchEnv:
    """Worlds of a `BatchTask`; `single` is the environment of one world, which describes spaces and weights.

    An episode depends on its seed and actions only: not on how many worlds there are, nor on what they do.
    """

    def __init__(self, task: BatchTask, worlds: int, single: TaskEnv, sim: str) -> None:
        self.task, self.worlds, self.name = task, worlds, single.name
        self._single = single
        self._space = single.action_space
        self.weights = single.reward_weights
        self.max_steps, self.has_success = single.max_steps, single.has_success
        if task.observation_layout != "flat" or not isinstance(self._space, spaces.Box):
            raise TaskError(f"{self.name}: a BatchTask has flat observations and actions in a Box")
        solref = read_solref(sim)
        if solref is None:
            raise TaskError(f"{self.name}: a BatchTask is simulated in MuJoCo only: sim: mujoco")
        iterations = task.solver_iterations
        self.sim = MujocoSim(
            control_dt=task.control_dt, substeps=task.substeps, solref=solref, iterations=iterations, worlds=worlds
        )
        self._all = np.arange(worlds)
        self.step_of = np.zeros(worlds, np.int64)
        """Steps since the start of each world's episode."""
        self._streams: list[Streams] = [{} for _ in range(worlds)]
        self._levels = np.ones(worlds)
        self.drawn: list[dict[str, Drawn]] = [{} for _ in range(worlds)]  # by events, in the running episodes
        task.prepare(self.sim, worlds)
        self.sim.save()
        self.set_events(single)
        self._sizes = {name: int(np.size(value)) for name, value in single._first.items()}
        self._view = self._make_view(single.view)
        teacher = single.teacher
        self._teacher_view = None if teacher is None else self._make_view(teacher.view)
        self.for_teacher = np.zeros((worlds, 0 if self._teacher_view is None else self._teacher_view.size), np.float32)
        """What a teacher sees now of each world, shape (worlds, size)."""
        disturbed = () if teacher is None else teacher.disturbed
        self._disturbed = np.concatenate([[name in disturbed] * size for name, size in self._sizes.items()])

    @property
    def _views(self) -> list[BatchView]:
        return [self._view] if self._teacher_view is None else [self._view, self._teacher_view]

    def _make_view(self, view: View) -> BatchView:
        privileged = self._single._examples[0]
        sizes = {**self._sizes, **{name: int(np.size(privileged[name])) for name in view.privileged}}
        return BatchView(self.worlds, view, sizes, self.task.history_start)

    def set_events(self, single: TaskEnv) -> None:
        """Let the events of `single` act from the next resets on."""
        self._single = single
        self._events = single.events
        self._acting = ActingEvents(self._events, self.task.control_dt)
        shown = single.privileged
        self._privileged = None if shown is None else np.zeros((self.worlds, shown.size), np.float32)
        self._signals: BatchSignals | None = None
        if any(event.event.when in ("observation", "action") for event in self._events.values()):
            assert isinstance(self._space, spaces.Box)
            bounds = self.task.observation_bounds
            self._signals = BatchSignals(self.worlds, self._events, single._first, self._space, bounds)

    def reset(self, worlds: Worlds, seeds: Sequence[int], levels: Array | None = None) -> NDArray[np.float32]:
        """Begin the episodes of `seeds` in `worlds`; return their first observations, shape (k, size).

        `levels`, shape (k,), is how hard they are; by default as the single environment's.
        """
        self.sim.restore(worlds)
        self.step_of[worlds] = 0
        generators = [np_random(int(seed))[0] for seed in seeds]
        self._levels[worlds] = self.task.level[worlds] = self._single.level if levels is None else levels
        if self._privileged is not None:
            self._privileged[worlds] = 0.0  # what is of an event that has not acted yet
        for world, seed in zip(worlds.tolist(), seeds, strict=True):
            self.drawn[world] = {}
            self._streams[world] = seed_streams(self._events, int(seed))
            self._act("reset", world)
        self.task.clear_kept(worlds)
        self.task.reset(WorldRngs(generators), worlds)
        for world in worlds.tolist():
            self._act("start", world)
            if self._signals is not None:
                self._signals.begin(world, self._streams[world], float(self._levels[world]))
        for view in self._views:
            view.begin(worlds)
        with self._leave_others(worlds):
            observation = self._observe(worlds)
            self._check_kept("reset")
        if self._signals is not None:
            for world in worlds.tolist():
                self._note(world, self._signals.drawn[world])
        return observation

    def observe_privileged(self, worlds: Worlds) -> NDArray[np.float32]:
        """Return what only the critic sees now in some worlds, shape (k, size); call `show_critic` of the single."""
        shown, rows = self._single.privileged, self._privileged
        assert shown is not None
        assert rows is not None
        with self._leave_others(worlds):
            parts = shown.read_task(self.task)
            for name, value in parts.items() if isinstance(parts, dict) else ():
                read_rows(self.name, f"privileged()[{name!r}]", value, (self.worlds, None), np.float64)
            shown.write_task(rows, parts)
        chosen = rows[worlds]
        bad = ~np.isfinite(chosen.sum(axis=1))
        if bad.any():
            row = int(bad.argmax())
            self._fail(worlds[row], f"privileged {shown.find_fault(chosen[row])!r} is not finite")
        return chosen

    def _note(self, world: int, drawn: Mapping[str, Drawn]) -> None:
        """Keep what events drew, and let the critic see it."""
        self.drawn[world].update(drawn)
        if self._privileged is not None and self._single.privileged is not None:
            with in_world(world):
                self._single.privileged.write_events(self._privileged[world], drawn)

    def _act(self, when: Literal["reset", "start"], world: int) -> None:
        if self._events:
            with in_world(world):
                drawn = self._acting.run(when, self.sim.one(world), self._streams[world], float(self._levels[world]))
            self._note(world, drawn)

    def step(self, action: NDArray[Any], worlds: Worlds | None = None) -> BatchStep:
        """Advance all worlds, or some, by a control step; `action` has a row for each of them, shape (k, ...)."""
        rows = self._all if worlds is None else worlds
        self.step_of[rows] += 1
        chosen = self._check_action(action, rows)
        with self._leave_others(rows):
            return self._step(chosen, rows)

    def _step(self, chosen: NDArray[Any], rows: Worlds) -> BatchStep:
        self.task.act(self._spread(chosen if self._signals is None else self._signals.act(chosen, rows), rows))
        self.sim.step(None if rows is self._all else rows)
        terminated = self._read_flags("is_terminated")[rows]
        truncated = ~terminated & (self.step_of[rows] >= self.max_steps)
        terms = self._read_terms(self._spread(chosen, rows))[rows]
        reward = np.zeros(len(rows))
        for index, weight in enumerate(self.weights.values()):  # in the order of `TaskEnv`, for the same last bits
            reward += weight * terms[:, index]
        self._check_finite(reward, terms, rows)
        self._run_due(rows)
        success = self._read_flags("is_success")[rows] if self.has_success else None
        observation = self._observe(rows)
        self._check_kept("a step")
        return BatchStep(observation, reward, terminated, truncated, terms, success)

    def _spread(self, values: NDArray[Any], worlds: Worlds) -> NDArray[Any]:
        if worlds is self._all:
            return values
        full = np.zeros((self.worlds, *values.shape[1:]), values.dtype)
        full[worlds] = values
        return full

    @contextlib.contextmanager
    def _leave_others(self, worlds: Worlds) -> Iterator[None]:
        """Take back what the task's methods, which see all worlds, change in the others than `worlds`."""
        if len(worlds) == self.worlds:
            yield
            return
        others = np.setdiff1d(self._all, worlds)
        kept = {name: getattr(self.task, name)[others] for name in self.task.per_world}
        try:
            with self.sim.keep(others):
                yield
        finally:
            for name, values in kept.items():
                getattr(self.task, name)[others] = values

    def _check_kept(self, when: str) -> None:
        for name, shape in self.task.per_world.items():
            value = getattr(self.task, name)
            if np.shape(value) != (self.worlds, *shape):
                raise TaskError(
                    f"{self.name}: after {when} self.{name} has shape {np.shape(value)}; per_world declares "
                    f"{(self.worlds, *shape)}"
                )

    def _check_action(self, action: NDArray[Any], rows: Worlds) -> NDArray[Any]:
        space = self._space
        assert isinstance(space, spaces.Box)
        given = np.asarray(action, space.dtype)
        if given.shape != (len(rows), *space.shape):
            raise TaskError(f"{self.name}: actions of shape {given.shape}, expected {(len(rows), *space.shape)}")
        bad = ~np.isfinite(given).reshape(len(rows), -1).all(axis=1)
        if bad.any():
            self._fail(rows[bad.argmax()], "action is not finite")
        clipped: NDArray[Any] = np.minimum(np.maximum(given, space.low), space.high)
        return clipped

    def _fail(self, world: int, message: str) -> NoReturn:
        raise WorldFailed(f"{self.name}: {message} at step {self.step_of[world]}", int(world))

    def _read_flags(self, method: str) -> NDArray[np.bool_]:
        return read_rows(self.name, f"{method}()", getattr(self.task, method)(), (self.worlds,), bool)

    def _read_terms(self, action: NDArray[Any]) -> Array:
        raw = self.task.rewards(action)
        if not isinstance(raw, dict) or raw.keys() != self.weights.keys():
            raise TaskError(
                f"{self.name}: rewards() returned {short_repr(list(raw))}; reward_weights has {list(self.weights)}"
            )
        terms = np.empty((self.worlds, len(self.weights)))
        for index, name in enumerate(self.weights):
            terms[:, index] = read_rows(self.name, f"rewards()[{name!r}]", raw[name], (self.worlds,), np.float64)
        return terms

    def _check_finite(self, reward: Array, terms: Array, rows: Worlds) -> None:
        bad = ~np.isfinite(reward)
        if bad.any():
            row = int(bad.argmax())
            term = next((name for name, x in zip(self.weights, terms[row], strict=True) if not np.isfinite(x)), "sum")
            self._fail(rows[row], f"reward term {term!r} is not finite")

    def _run_due(self, rows: Worlds) -> None:
        if not self._acting.periods:
            return
        due = np.any([self.step_of[rows] % period == 0 for period in set(self._acting.periods)], axis=0)
        for world in rows[due].tolist():
            step, level = int(self.step_of[world]), float(self._levels[world])
            with in_world(world):
                drawn = self._acting.run_due(step, self.sim.one(world), self._streams[world], level)
            self._note(world, drawn)

    def _observe(self, rows: Worlds) -> NDArray[np.float32]:
        parts = self.task.observe()
        if not isinstance(parts, dict) or list(parts) != list(self._sizes):
            names = list(self._sizes)
            raise TaskError(f"{self.name}: observe() returned {short_repr(list(parts))}, at first {names}")
        if self.task.observation_terms:
            parts = compute_terms(self.name, self.task.observation_terms, parts)
        exact = self._read_columns("observe", parts, self._sizes)[rows]
        changed = exact if self._teacher_view is None else exact.copy()
        seen = exact if self._signals is None else self._signals.observe(changed, rows)
        try:
            if self._teacher_view is not None and self._single.teacher is not None:
                taught = np.where(self._disturbed, seen, exact)
                columns = self._add_privileged(taught, self._single.teacher.view, rows)
                self.for_teacher[rows] = self._teacher_view.assemble(columns, rows)
            return self._view.assemble(self._add_privileged(seen, self._single.view, rows), rows)
        except RowFault as fault:
            self._fail(rows[fault.row], str(fault))

    def _read_columns(self, method: str, parts: Mapping[str, Any], sizes: Mapping[str, int]) -> Array:
        columns = [
            read_rows(self.name, f"{method}()[{name!r}]", parts[name], (self.worlds, size), np.float64)
            for name, size in sizes.items()
        ]
        return np.concatenate(columns, axis=1)

    def _add_privileged(self, columns: Array, view: View | None, rows: Worlds) -> Array:
        """Return columns with those that a view has of what the task's `privileged` returns, after them."""
        if view is None or not view.privileged:
            return columns
        examples = self._single._examples[0]
        sizes = {name: int(np.size(examples[name])) for name in view.privileged}
        return np.concatenate([columns, self._read_columns("privileged", self.task.privileged(), sizes)[rows]], axis=1)

    def close(self) -> None:
        """End the simulation."""
        self.sim.close()
