"""`rlctl robot`: simulate a task's robot, let a program control it, and return how well it did."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import math
import selectors
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl import output
from rlctl.environments.info import EnvInfo, describe
from rlctl.environments.spec import EnvChanges, EnvSpec
from rlctl.errors import AnswerIsNo, UsageError, explain_missing_package
from rlctl.evaluation.episode_statistics import summarize
from rlctl.evaluation.eval_request import Gates
from rlctl.evaluation.players import resolve_task
from rlctl.evaluation.robustness import Outcome
from rlctl.play.messages import EpisodeResult
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.policy.load import load_policy
from rlctl.policy.policy import Policy
from rlctl.policy.shipped import PRETRAINED
from rlctl.runs import lookup
from rlctl.version import __version__
from rlctl_robot.robot import packets
from rlctl_robot.robot.commands import CommandCounts
from rlctl_robot.robot.comparison import CommandComparison
from rlctl_robot.robot.faults import Faults, parse_faults, set_stuck_joints
from rlctl_robot.robot.interface import ControllerInterface, Interface, PolicyInterface
from rlctl_robot.robot.listener import wait_for_controller
from rlctl_robot.robot.player import RobotPlayer
from rlctl_robot.robot.robot_request import RobotRequest
from rlctl_robot.serve.access import find_key

if TYPE_CHECKING:
    from rlctl_robot.robot.websocket import Door


@dataclasses.dataclass(frozen=True)
class FaultScore:
    """The score of the program with some faults."""

    faults: Faults
    outcome: Outcome
    episodes: list[EpisodeResult]
    commands: CommandCounts
    seconds: float  # that the episodes took


@dataclasses.dataclass(frozen=True)
class RobotReport:
    """How well a program has controlled the robot: without faults, then with each request of faults."""

    spec: EnvSpec
    info: EnvInfo
    controller: str  # how the program was connected
    command: str  # what a command is, in words
    policy: Path | None  # the policy to which its commands were compared
    seed: int
    realtime: bool
    scores: list[FaultScore]
    problem: str = ""  # why the program could not be tested to the end

    def check(self, gates: Gates) -> None:
        """Raise `AnswerIsNo` for a program that went away, or naming every gate that was missed."""
        if self.problem:
            raise AnswerIsNo(self.problem)
        if missed := self.list_missed(gates):
            raise AnswerIsNo("gate missed: " + "; ".join(missed))

    def list_missed(self, gates: Gates) -> list[str]:
        """Return a phrase for each gate that was missed."""
        missed = []
        for score in self.scores:
            outcome, where = score.outcome, f" with {score.faults.text}" if score.faults.text else ""
            found = gates.list_missed(outcome.success_rate, outcome.success_interval, outcome.mean_return)
            missed += [f"{phrase}{where}" for phrase in found]
        return missed


def run_robot(
    request: RobotRequest,
    on_start: Callable[[list[str]], None],
    *,
    pretrained: bool = False,
    changes: EnvChanges,
    gates: Gates,
) -> RobotReport:
    """Wait for a program, let it control the robot in all episodes, and return its scores.

    `on_start` is called with the addresses at which it can connect. Raises `AnswerIsNo` if no program connects.
    """
    gates.check_reachable(request.episodes)
    faults = [Faults(), *map(parse_faults, request.fault)]
    file, policy = _find_policy(request, pretrained)
    spec = _choose_spec(request.task, policy, changes)
    with contextlib.closing(spec.make()) as env:
        info = describe(env)
        if info.reward_weights:
            gates.check_possible(info.has_success)
        if request.realtime and info.control_dt is None:
            raise UsageError(f"--realtime: {spec.task} has no control_dt, so its steps take no known time")
        interface = (ControllerInterface if request.controller else PolicyInterface)(env, info)
        for fault in faults:
            fault.check(interface.shapes, info.control_dt)
            set_stuck_joints(env, spec, fault.stuck)  # raises before a program connects
        if policy is not None and file is not None and policy.info.spec.frame_stack == 1:
            policy.info.check_fits(info, file)
        comparison = None if policy is None else CommandComparison(policy, interface, name_actions(info, env))
        test = _Test(request, env, info, spec, interface, comparison)
        with asyncio.Runner(loop_factory=_make_loop) as runner:
            name, scores, problem = runner.run(test.run(faults, on_start))
    if scores:
        gates.check_possible(scores[0].outcome.success_rate is not None)
    return RobotReport(spec, info, name, interface.answer, file, request.seed, request.realtime, scores, problem)


def _make_loop() -> asyncio.AbstractEventLoop:
    # epoll, and uvloop's timers, wake up to a millisecond late: select takes microseconds.
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def _find_policy(request: RobotRequest, pretrained: bool) -> tuple[Path | None, Policy | None]:
    if pretrained and request.policy is not None:
        raise UsageError("--pretrained and --policy exclude each other")
    named = request.policy
    if lookup.is_policy_file(request.task):
        if pretrained or named is not None:
            raise UsageError(f"{request.task}: a policy file; leave out --policy and --pretrained, or name its task")
        named = request.task
    if not pretrained and named is None:
        return None, None
    found = lookup.find_policy(named or request.task, PRETRAINED if pretrained else "best")
    output.print_notes(found.notes)
    return found.file, load_policy(found.file)


def _choose_spec(task: str, policy: Policy | None, changes: EnvChanges) -> EnvSpec:
    """Return the environment of the policy's training, or of the task's recipe; a robot measures no stacked frames."""
    if policy is None:
        return changes.apply(resolve_task(task).as_deployed())
    other = None if lookup.is_policy_file(task) else task
    spec = policy.info.derive_spec(other, changes).as_deployed()
    return dataclasses.replace(spec.resolve(), frame_stack=1)


def name_actions(info: EnvInfo, env: Any) -> list[str]:
    """Return a name for each element of the action: its joint, if the task describes its joints."""
    size = math.prod(env.action_space.shape or ())
    return list(info.joints.names) if info.joints is not None else [f"action {index}" for index in range(size)]


class _Test:
    def __init__(
        self,
        request: RobotRequest,
        env: Any,
        info: EnvInfo,
        spec: EnvSpec,
        interface: Interface,
        comparison: CommandComparison | None,
    ) -> None:
        self._request, self._env, self._info, self._spec = request, env, info, spec
        self._interface, self._comparison = interface, comparison

    async def run(
        self, faults: list[Faults], on_start: Callable[[list[str]], None]
    ) -> tuple[str, list[FaultScore], str]:
        request, udp_sizes = self._request, self._find_udp_sizes()
        key = find_key(request.host, request.key_file)
        door = self._make_door(key, is_needed=udp_sizes is None)
        waiting = wait_for_controller(request, key, door, udp_sizes, on_start)
        async with waiting as controller:
            player = RobotPlayer(
                self._env,
                self._info,
                controller,
                self._interface,
                task=self._spec.task,
                level=self._spec.level,
                timeout_s=request.timeout_s,
                realtime=request.realtime,
                comparison=self._comparison,
            )
            scores: list[FaultScore] = []
            try:
                for fault in faults:
                    scores.append(await self._score(player, fault))
            except AnswerIsNo as error:
                where = f", with {fault.text}" if fault.text else ""
                return controller.name, scores, f"{error}{where}"
            finally:
                await controller.end()
            return controller.name, scores, ""

    async def _score(self, player: RobotPlayer, faults: Faults) -> FaultScore:
        set_stuck_joints(self._env, self._spec, faults.stuck)
        seeds = episode_seeds(self._request.seed, Stream.EVAL, self._request.episodes)
        begin = time.perf_counter()
        with output.show_progress(faults.text or "playing", len(seeds), "episodes") as show:
            results, counts = await player.play(seeds, faults, show)
        return FaultScore(faults, summarize(results), results, counts, time.perf_counter() - begin)

    def _make_door(self, key: str | None, *, is_needed: bool) -> Door | None:
        """Return what takes WebSocket clients; None without its packages, which UDP does not need."""
        try:
            from rlctl_robot.robot.websocket import Door
        except ModuleNotFoundError as error:
            install = explain_missing_package("a WebSocket", error.name, "serve")
            if is_needed:
                raise UsageError(f"{install}; images and discrete actions have no UDP") from None
            output.print_notes([f"only UDP: {install}"])
            return None
        return Door(self._request, key, self._describe())

    def _describe(self) -> dict[str, Any]:
        """Return the first message to a program: what a policy server tells its clients, as far as a robot knows it."""
        info = self._info
        return {
            "server": f"rlctl {__version__}",
            "task": self._spec.task,
            "control_dt": info.control_dt,
            "observation": {name: list(shape) for name, shape in self._interface.shapes.items()},
            "observation_units": self._interface.units,
            "command": self._interface.answer,
            "action_meaning": info.action_meaning,
            "env": info.model_dump(mode="json"),
        }

    def _find_udp_sizes(self) -> tuple[int, int] | None:
        """Return the sizes of packets; None for images, discrete actions and what does not fit into a packet."""
        sizes = self._interface.sizes
        return sizes if sizes is not None and max(sizes) <= packets.MOST_VALUES else None
