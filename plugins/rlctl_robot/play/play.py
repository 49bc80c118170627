"""`rlctl play`: simulate a policy's robot by the clock, show it on a page, and do what a person wants there."""

from __future__ import annotations

import base64
import dataclasses
import itertools
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl import output
from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError, explain_missing_package
from rlctl.play.seeds import Stream, episode_seed
from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.recorder import DEFAULT_DT, Choose, LogEntry, Rollout, find_dt, make_reader, play_episode
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.reproduce import print_warning
from rlctl.replaying.scene import Env
from rlctl.replaying.sources import PolicySource
from rlctl_robot.play.controls import Controls, PageMessage
from rlctl_robot.play.drawing import describe_shapes, list_poses
from rlctl_robot.play.play_request import PlayRequest
from rlctl_robot.play.robot_world import RobotWorld

if TYPE_CHECKING:
    from rlctl_robot.play.page_server import PageServer

_FRAME_S = 1 / 30  # between two pictures
_IDLE_S = 0.1  # between two looks at the wishes while the clock stands
_LONGEST_S = 600.0  # of an episode, whose steps are kept in memory
_SHOW_END_S = 1.0  # how long the end of an episode is shown, such as a fall
_LOG_EVERY_S = 0.5  # between two lines about commands in the log of a recording


@dataclasses.dataclass
class PlayResult:
    """What was played."""

    task: str
    policy: str
    episodes: int = 0
    steps: int = 0
    late: int = 0  # steps that ended more than `control_dt` after their time
    recordings: list[Path] = dataclasses.field(default_factory=list)


def run_play(request: PlayRequest, on_start: Callable[[str], None]) -> PlayResult:
    """Play until SIGINT or SIGTERM; `on_start` is called with the address of the page."""
    try:
        from rlctl_robot.play.page_server import PageServer
    except ModuleNotFoundError as error:
        raise UsageError(explain_missing_package("rlctl play", error.name, "serve")) from None
    source = PolicySource(
        ReplayRequest(
            request.run,
            seed=request.seed,
            checkpoint=request.checkpoint,
            task=request.task,
            settings=request.settings,
            sim=request.sim,
            output=request.output,
        )
    )
    controls = Controls(record=request.record)
    server = PageServer(request.port, controls)
    spec = source.spec.as_deployed()
    with closing(make_drawable(spec)) as env, _stop_on_signals(controls):
        game = Game(env, spec, source, controls, server)
        on_start(server.start())
        try:
            return game.play(request.seed)
        finally:
            server.close()


@contextmanager
def _stop_on_signals(controls: Controls) -> Iterator[None]:
    """End the game at the first signal, so that a recording is written; the second one interrupts."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = [signal.getsignal(number) for number in numbers]

    def stop(number: int, frame: Any) -> None:
        restore()
        controls.stop()

    def restore() -> None:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)

    for number in numbers:
        signal.signal(number, stop)
    try:
        yield
    finally:
        restore()


class Game:
    """Episodes of a policy that a person steers, one after the other."""

    def __init__(self, env: Env, spec: EnvSpec, source: PolicySource, controls: Controls, server: PageServer) -> None:
        self._env, self._spec, self._source = env, spec, source
        self._controls, self._server = controls, server
        self._dt = find_dt(env) or DEFAULT_DT
        self._world = RobotWorld(env)
        self._warned: set[str] = set()
        self._reader = make_reader(env, self._warn)
        self._info = describe(env)
        if not spec.time_feature:  # else the policy observes how much time is left
            self._world.remove_time_limit()
        # The robot stands until the person does something.
        self._velocities = [name for name, command in self._world.commands().items() if command.self_centering]
        controls.apply(PageMessage(commands=dict.fromkeys(self._velocities, 0.0)))
        self.result = PlayResult(spec.task, source.name)

    def play(self, seed: int) -> PlayResult:
        """Play until the person or a signal ends it; the seeds of episodes follow from `seed`."""
        for number in itertools.count():
            wishes = self._controls.take()
            if wishes.stop:
                return self.result
            self._recording = wishes.record
            rollout = self._play_episode(episode_seed(seed, Stream.REPLAY, 0, number))
            self._finish(rollout)
            if rollout.ended:
                self._show("ended")
                self._controls.wait(_SHOW_END_S)
        raise AssertionError

    def _finish(self, rollout: Rollout) -> None:
        """Count an episode, or the steps before an error, and write what is to be recorded."""
        self.result.episodes += 1
        self.result.steps += rollout.length
        if self._recording and rollout.length:
            self._write(rollout)

    def _warn(self, text: str) -> None:
        """Print a warning once: the world is read for each picture."""
        if text not in self._warned:
            self._warned.add(text)
            print_warning(text)

    def _play_episode(self, seed: int) -> Rollout:
        policy = self._source.begin(self._env, seed)
        self._log: list[LogEntry] = []
        self._logged: dict[str, float] = {}  # commands that are in the log
        self._logged_s = (
            self._shown_s
        ) = -1.0  # when the last ones were written [s of the episode], the last frame shown
        self._seed, self._speed = seed, 1.0
        self._world.begin()
        self._controls.keep_commands(self._velocities)
        draw = self._warn if self._recording else None
        name = f"{self._source.name}, steered by a person"
        return play_episode(
            self._env,
            self._spec,
            seed,
            self._steer(policy),
            policy=name,
            draw=draw,
            watch=self._watch,
            salvage=self._finish,
        )

    def _steer(self, policy: Choose) -> Choose:
        def choose(observation: Any, step: int) -> Any:
            if not self._obey(step):
                return None
            return policy(observation, step)

        return choose

    def _obey(self, step: int) -> bool:
        """Do what the person wants, and wait for the time of the next step; return whether the episode goes on."""
        while True:
            wishes = self._controls.take()
            if wishes.stop or wishes.reset or step * self._dt >= _LONGEST_S:
                return False
            for text in self._world.apply(wishes):
                self._log.append(LogEntry(step, text))
            self._log_commands(step, wishes.commands)
            self._paused, self._speed = wishes.paused, wishes.speed
            if not wishes.paused:
                break
            self._show_in_time()
            self._controls.wait(_IDLE_S)
            self._next_s = time.monotonic()
        self._next_s += self._dt / self._speed
        left = self._next_s - time.monotonic()
        if left > 0:
            time.sleep(left)
        elif left < -self._dt:
            self.result.late += 1
            self._next_s = time.monotonic()  # what was missed is not made up for
        return True

    def _log_commands(self, step: int, commands: dict[str, float]) -> None:
        """Write changed commands into the log of a recording, twice a second at most."""
        now_s = step * self._dt
        changed = {name: value for name, value in commands.items() if self._logged.get(name) != value}
        if changed and now_s >= self._logged_s + _LOG_EVERY_S:
            self._logged, self._logged_s = dict(commands), now_s
            text = ", ".join(f"{name} {value:.3g}" for name, value in changed.items())
            self._log.append(LogEntry(step, f"command {text}"))

    def _watch(self, step: int) -> None:
        self._step = step
        if step == 0:
            self._next_s, self._paused = time.monotonic(), False
            self._reader.read(0)
            self._server.describe(self._describe())
        self._show_in_time()

    def _show_in_time(self) -> None:
        if (now := time.monotonic()) - self._shown_s >= _FRAME_S:
            self._shown_s = now
            self._show()

    def _show(self, end: str = "") -> None:
        self._reader.read(0)  # it reads one step only, as if it were the first
        scene = self._reader.scene()
        commands = self._world.commands()
        self._server.show(
            {
                "poses": list_poses(scene),
                "picture": base64.b64encode(scene.pictures[-1][1]).decode() if scene.pictures else None,
                "markers": {name: positions[-1].tolist() for name, positions in scene.markers.items()},
                "center": self._world.find_center(),
                "time": round(self._step * self._dt, 3),
                "commands": {name: float(command.value) for name, command in commands.items()},
                "paused": self._paused,
                "speed": self._speed,
                "recording": self._recording,
                "state": end,
                "late": self.result.late,
                "written": [str(path) for path in self.result.recordings[-1:]],
            }
        )

    def _describe(self) -> dict[str, Any]:
        commands = self._world.commands()
        return {
            "task": self._spec.task,
            "robot": self._info.robot,
            "policy": self._source.name,
            "seed": self._seed,
            "commands": {
                name: {
                    "low": command.low,
                    "high": command.high,
                    "unit": command.unit,
                    "centers": command.self_centering,
                }
                for name, command in commands.items()
            },
            "can_push": self._world.can_push,
            "can_change_friction": self._world.can_change_friction,
            **describe_shapes(self._reader.scene()),
        }

    def _write(self, rollout: Rollout) -> None:
        from rlctl.replaying.rrd import write_rrd  # takes a second

        info = rollout.episode.info.model_copy(update={"steered": True})
        log = sorted([*rollout.log, *self._log], key=lambda entry: entry.step)
        steered = dataclasses.replace(rollout, episode=dataclasses.replace(rollout.episode, info=info), log=log)
        recording = self._source.save(len(self.result.recordings), steered.episode).with_suffix(".rrd")
        title = f"{self._spec.task} / episode {recording.stem}, steered by a person"
        write_rrd(recording, steered, title=title, warn=self._warn)
        self.result.recordings.append(recording)
        output.print_notes([f"recording: {recording}"])


def show(result: PlayResult, json: str | None) -> None:
    """Print what was played, or JSON alone for `-`."""
    if output.present(result, json):
        return
    out = output.out()
    episodes, steps = output.format_count(result.episodes, "episode"), output.format_count(result.steps, "step")
    out.print(f"{result.task}: {episodes}, {steps}, {result.late:,} of them late")
    for recording in result.recordings:
        out.print(f"recording {recording}")
