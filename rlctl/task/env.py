"""`TaskEnv`: a task as a Gymnasium environment, a view of row 0 of its worlds."""

import copy
from collections.abc import Mapping
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from rlctl.engine import Engine
from rlctl.errors import RecipeError, TaskError
from rlctl.task.batch import BatchTask
from rlctl.task.commands import CommandTerm
from rlctl.task.events import Event, EventSettings
from rlctl.task.events.event import Drawn
from rlctl.task.observation import Observation, Observing, View
from rlctl.task.sim import Sim
from rlctl.task.task import Task
from rlctl.task.worlds import TaskWorlds, WorldsStep, take_row

_ROW = np.zeros(1, np.int64)


class TaskEnv(gymnasium.Env[Observation, Any]):
    """Steps a `Task` or one world of a `BatchTask`: act, physics, terminated, rewards, interval events, observe.

    `info` holds `reward_terms` (weighted; they add up to the reward), `metrics` (every raw term), `is_success`
    where the task defines it, and, in steps with events, `events` (the drawn values). `sim` is the engine,
    by default that of `choose_engine`. Without `visuals` MuJoCo loads visual
    shapes only when the task takes its first picture. `observing` is what the policy sees.
    """

    def __init__(
        self,
        task: Task | BatchTask,
        *,
        render_mode: Literal["human", "rgb_array"] | None = None,
        reward_weights: Mapping[str, float] | None = None,
        events: EventSettings | None = None,
        sim: Engine = Engine(),  # noqa: B008 (it cannot change)
        visuals: bool = True,
        observing: Observing = Observing(),  # noqa: B008 (it cannot change)
    ) -> None:
        if render_mode not in (None, "human", "rgb_array"):
            raise RecipeError(f"render_mode {render_mode!r} is not one of: human, rgb_array")
        self.worlds = TaskWorlds(
            task,
            render_mode=render_mode,
            reward_weights=reward_weights,
            events=events,
            sim=sim,
            visuals=visuals,
            observing=observing,
        )
        self.task, self.name = task, self.worlds.name
        self.sim: Sim = self.worlds.sim_of(0)
        # gymnasium.Env has one dict for all environments.
        self.metadata = {"render_modes": ["human", "rgb_array"], "render_fps": round(1 / task.control_dt)}
        self._spec: EnvSpec | None = None
        self.render_mode = render_mode
        self.reward_weights, self.has_success = self.worlds.weights, self.worlds.has_success
        self.max_steps = self.worlds.max_steps
        self.action_space, self.observation_space = self.worlds.action_space, self.worlds.view.space
        self.observation_sizes = self.worlds.view.sizes
        if self.worlds.compute_reward is not None:
            # Only then: code that relabels goals checks whether an environment has this method.
            self.compute_reward = self.worlds.compute_reward
        self._running = self._closed = False

    @property
    def view(self) -> View:
        """What the policy sees."""
        return self.worlds.view

    @property
    def events(self) -> Mapping[str, Any]:
        """The events that act, by name."""
        return self.worlds.events

    @property
    def drawn(self) -> dict[str, Drawn]:
        """Values that the events of this episode drew, the last ones of those at an interval."""
        return self.worlds.drawn[0]

    @property
    def measured(self) -> dict[str, Any]:
        """What the last observation's terms were computed from, by the name of the term."""
        return self.worlds.measured_of(0)

    def observe_exactly(self) -> dict[str, Any]:
        """Return what the task observes now without noise and delay, by name, its terms computed."""
        return {name: value[0] for name, value in self.worlds.observe_exactly().items()}

    def set_level(self, level: float) -> None:
        """Set the level of the task, and of ranges written `{from: ..., to: ...}`, from 0 to 1, for the next resets."""
        self.worlds.level = float(level)

    def set_events(self, events: EventSettings, added: Mapping[str, Event] | None = None) -> None:
        """Let only the events of `events` and the `added` ones act; call `reset` afterwards."""
        self.worlds.set_events(events, added)
        self._running = False

    def act(self, action: Any) -> None:
        """Set motor targets, without simulated time and without noise or delay."""
        self.worlds.calls.act(np.asarray(action)[None])

    def observe_quantities(self) -> dict[str, Any]:
        """Return what the task observes now, by name: the quantities of terms, a tuple if there are several."""
        return {name: take_row(value) for name, value in self.worlds.calls.observe().items()}

    def is_terminated(self) -> bool:
        """Return whether the task would end the episode now."""
        return bool(self.worlds.calls.is_terminated()[0])

    def markers(self) -> dict[str, Any]:
        """Return points to draw by name, each of shape (3,) [m]."""
        return {name: value[0] for name, value in self.worlds.calls.markers().items()}

    def commands(self) -> dict[str, CommandTerm]:
        """Return what a person may command, by name."""
        commands: dict[str, CommandTerm] = self.task.commands()
        if isinstance(self.task, BatchTask):
            return {name: command._replace(value=command.value[0]) for name, command in commands.items()}
        return commands

    def set_commands(self, values: Mapping[str, float]) -> None:
        """Set some of the `commands`, within their ranges."""
        if isinstance(self.task, BatchTask):
            self.task.set_commands({name: np.array([value]) for name, value in values.items()})
        else:
            self.task.set_commands(values)

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
        if seed is None and self.events:
            seed = int(self.np_random.integers(2**63))
        # Without a seed the generator goes on, as Gymnasium asks.
        observation = take_row(self.worlds.reset(_ROW, [seed or 0], generators=[self.np_random]))
        self._running = True
        if self.render_mode == "human":
            self.move_markers()
        return observation, {"events": dict(self.drawn)} if self.drawn else {}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance one control step of `control_dt` seconds."""
        if not self._running:
            raise TaskError(f"{self.name}: step() before reset(), after the episode's end, or after close()")
        result = self.worlds.step([action])
        self._running = not (result.terminated[0] or result.truncated[0])
        if self.render_mode == "human":
            self.move_markers()
        info = self._describe(result)
        flags = bool(result.terminated[0]), bool(result.truncated[0])
        return take_row(result.observation), float(result.reward[0]), *flags, info

    def _describe(self, result: WorldsStep) -> dict[str, Any]:
        raw = dict(zip(self.reward_weights, result.terms[0].tolist(), strict=True))
        terms = {name: weight * raw[name] for name, weight in self.reward_weights.items()}
        info: dict[str, Any] = {"reward_terms": terms, "metrics": raw}
        if self.worlds.drawn_now:
            info["events"] = self.worlds.drawn_now
        if result.success is not None:
            info["is_success"] = bool(result.success[0])
        return info

    def move_markers(self) -> None:
        """Move the drawn markers to their current positions in the task."""
        self.worlds.move_markers()

    def render(self) -> Any:
        """Return an RGB image of shape (240, 320, 3) in `rgb_array` mode; None in `human` mode, which has a window."""
        if self.render_mode != "rgb_array":
            return None
        self.move_markers()
        return self.sim.render()

    def close(self) -> None:
        """End the simulation."""
        self._running, self._closed = False, True
        self.worlds.close()
