"""Plays the episodes of a robot whose actions a connected program commands, in lock-step or by the clock."""

import asyncio
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import take_row
from rlctl.environments.gym_worlds import GymWorlds
from rlctl.environments.info import EnvInfo
from rlctl.errors import AnswerIsNo
from rlctl.play.messages import EpisodeResult, FailedInEpisode, describe_failure, make_error
from rlctl_robot.robot.commands import CommandCounts, CommandQueue
from rlctl_robot.robot.comparison import CommandComparison
from rlctl_robot.robot.faults import EpisodeFaults, Faults
from rlctl_robot.robot.interface import Interface, Parts
from rlctl_robot.robot.program import Arrival, ControlProgram, SentObservation

_RESEND_S = 0.25  # after which an observation that is not answered is sent again: a UDP packet may be lost


_UPRIGHT = -0.5  # component z of the direction of gravity in the trunk's frame: a tilt of 60 degrees
_ROW = np.zeros(1, np.int64)


class RobotPlayer:
    """A robot that sends what it measures at every step, and does what the newest command says.

    A command that arrives within its control step acts in that step, as in training. Without a newer one the last
    command acts again; before the first one the action is 0, or the nearest to it. In lock-step the robot waits for
    each command, and delays are delays of the simulated time.
    """

    def __init__(
        self,
        env: Any,
        info: EnvInfo,
        controller: ControlProgram,
        interface: Interface,
        *,
        task: str,
        level: float,
        timeout_s: float,
        realtime: bool,
        comparison: CommandComparison | None,
    ) -> None:
        self._worlds = GymWorlds(env, level)
        self._seed = -1
        self._info, self._interface = info, interface
        self._task, self._timeout_s, self._realtime = task, timeout_s, realtime
        self._controller, self._comparison = controller, comparison
        self._dt = info.control_dt or math.inf
        self._loop = asyncio.get_running_loop()
        self._sequence = 0
        self._unanswered_s = math.inf  # when the first observation was sent since the program last sent something

    async def play(
        self, seeds: Sequence[int], faults: Faults, watch: Callable[[int], None]
    ) -> tuple[list[EpisodeResult], CommandCounts]:
        """Play an episode per seed; `watch` is called with the number of finished ones.

        Raises `AnswerIsNo` if the program disconnects or sends nothing for `timeout_s`, `TaskError` if the environment
        fails.
        """
        self._counts = counts = CommandCounts()
        if self._comparison is not None:
            self._comparison.reset()
        results = []
        for number, seed in enumerate(seeds):
            results.append(await self._play_episode(number, seed, faults))
            watch(number + 1)
        if self._comparison is not None:
            counts.compared, counts.differences = self._comparison.count, self._comparison.differences()
        return results, counts

    async def _play_episode(self, number: int, seed: int, faults: Faults) -> EpisodeResult:
        self._drawn = EpisodeFaults(faults, seed, self._info)
        self._queue, self._number = CommandQueue(), number
        self._waiting: dict[int, tuple[float, float, bool]] = {}  # by sequence: when it was sent, delay, loss
        if self._controller.arrivals:  # of the episode before
            self._controller.arrivals.clear()
            self._unanswered_s = math.inf
        self._begins, newest = True, None  # the newest command
        self._seed = seed
        observations = self._call(lambda: self._worlds.reset(_ROW, [seed]))
        self._begin_s = self._loop.time()
        while True:
            step = self._step
            measured = self._interface.measure(take_row(observations, 0))
            before = take_row(observations, 0)
            command = await self._exchange(measured, step)
            self._counts.held += command is None
            newest = newest if command is None else command
            action = self._interface.find_action(newest, measured, step)
            # `chosen` is bound now: the next step has another action.
            result = self._call(lambda chosen=action: self._worlds.step([chosen]))  # type: ignore[misc]
            observations = result.observation
            if result.terminated[0] or result.truncated[0]:
                self._counts.unanswered += len(self._waiting)
                self._count_end(before, bool(result.terminated[0]))
                return self._summarize()

    @property
    def _step(self) -> int:
        return int(self._worlds.step_of[0])

    def _count_end(self, observed: Any, is_terminated: bool) -> None:
        """Count how an episode ended; `observed` is its last observation but one."""
        self._counts.terminated += is_terminated
        sizes = self._info.observation_sizes
        if sizes.get("gravity") != 3 or not isinstance(observed, np.ndarray):
            return
        names = list(sizes)
        start = sum(sizes[name] for name in names[: names.index("gravity")])
        is_tilted = float(observed[start + 2]) > _UPRIGHT
        self._counts.tilted = (self._counts.tilted or 0) + is_tilted

    def _summarize(self) -> EpisodeResult:
        totals = self._worlds.totals(0)
        return EpisodeResult(
            env=0,
            seed=self._seed,
            total_reward=totals.reward,
            length=self._step,
            success=totals.success,
            terms=totals.terms,
            final_distance=totals.distance,
            row=0,
            metrics=totals.metrics,
            drawn=totals.drawn,
        )

    def _call(self, simulate: Callable[[], Any]) -> Any:
        try:
            return simulate()
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            if isinstance(error, KeyboardInterrupt):
                raise
            failure = FailedInEpisode(0, self._seed, self._step)
            failure.__cause__ = error
            raise make_error(describe_failure(failure), self._task) from error

    async def _exchange(self, measured: Parts, step: int) -> NDArray[Any] | None:
        """Send what the sensors measure; return the newest command at the end of the step, None if there is none."""
        self._sequence += 1
        lost, command_lost, delay_s = self._drawn.draw()
        parts, time_s = self._drawn.disturb(measured, step), 0.0 if math.isinf(self._dt) else step * self._dt
        sent = SentObservation(self._sequence, self._number, step, parts, self._begins, time_s, delay_s)
        if self._realtime:
            self._check_clock(step)
        self._counts.lost += lost or command_lost
        if not lost:
            now, self._begins = self._loop.time(), False
            self._waiting[self._sequence] = now, delay_s, command_lost
            self._unanswered_s = min(self._unanswered_s, now)
            await self._controller.send(sent)
            if self._comparison is not None:
                self._comparison.observe(sent)
        if self._realtime:
            await self._wait_for_clock(self._begin_s + (step + 1) * self._dt)
        elif not lost:
            await self._wait_for_command(sent)
        return self._queue.take((step + 1) * self._dt)

    def _check_clock(self, step: int) -> None:
        late = max(0.0, self._loop.time() - self._begin_s - step * self._dt)
        self._counts.robot_late_s.append(late)
        if late > self._dt:  # the simulation is too slow: the program has a whole step nevertheless
            self._begin_s += late

    async def _wait_for_clock(self, end_s: float) -> None:
        while True:
            await self._controller.wait(end_s)
            self._read_arrivals()
            self._check_present()
            if self._loop.time() >= end_s:
                return

    async def _wait_for_command(self, sent: SentObservation) -> None:
        while sent.sequence in self._waiting:
            again_s = self._loop.time() + _RESEND_S
            await self._controller.wait(again_s)
            self._read_arrivals()
            self._check_present()
            if self._loop.time() >= again_s and sent.sequence in self._waiting and self._controller.resends:
                await self._controller.send(sent)

    def _check_present(self) -> None:
        """Raise `AnswerIsNo` if the program is no longer there."""
        where = f"in episode {self._number}, step {self._step}"
        if self._controller.closed:
            raise AnswerIsNo(f"the program has disconnected {where}")
        if self._loop.time() - self._unanswered_s > self._timeout_s:
            raise AnswerIsNo(f"the program has sent nothing for {self._timeout_s:g} s, {where}")

    def _read_arrivals(self) -> None:
        while self._controller.arrivals:
            arrival = self._controller.arrivals.popleft()
            self._read(arrival)
            self._unanswered_s = arrival.at if self._waiting else math.inf

    def _read(self, arrival: Arrival) -> None:
        counts = self._counts
        problem, command = arrival.problem, None
        if not problem and arrival.values is not None:
            try:
                command = self._interface.read(arrival.values)
            except ValueError as error:
                problem = str(error)
        if problem:
            counts.refused += 1
            counts.first_problem = counts.first_problem or problem
        if (waiting := self._waiting.pop(arrival.sequence, None)) is None:
            return  # a second command for the same observation, or one for an episode that is over
        sent_s, delay_s, is_lost = waiting
        counts.response_s.append(arrival.at - sent_s)
        counts.late += counts.response_s[-1] > self._dt
        if command is None:
            return
        if self._comparison is not None:
            self._comparison.compare(arrival.sequence, command)
        if not is_lost:
            # In lock-step the simulated clock stands still while the program computes.
            step_s = (self._step * self._dt) if not self._realtime else arrival.at - self._begin_s
            self._queue.put((step_s if self._dt < math.inf else 0.0) + delay_s, arrival.sequence, command)
