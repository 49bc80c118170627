"""How fast the environment is: one, its reset, and sixty-four of them. No learning."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import SubprocVecEnv

import rlctl
from rlctl.environments.spec import EnvSpec
from rlctl.play.messages import Play
from rlctl.play.workers import Workers, available_cores
from rlctl.policy.actor import Exploration
from rlctl.task.model_files import MODELS
from rlctl.task.pybullet.library import pybullet
from tests.benchmarks.acting import make_policy
from tests.benchmarks.row import Row, side_by_side

TASK = "reach"
EPISODES = 10  # in a round
MANY, FEW = 64, 8  # environments
Commands = list[list[Callable[[], Any]]]


def one_environment(repeat: int) -> Row:
    """Count whole `step` calls of `TaskEnv` against `stepSimulation` alone, on the same states and motor targets."""
    env: Any = rlctl.make(TASK)
    actions = _random_actions(env.max_steps)
    commands = _recorded_commands(env, actions)

    def steps_per_second(one_episode: Callable[[], float]) -> float:
        return EPISODES * len(actions) / sum(one_episode() for _ in range(EPISODES))

    pair = side_by_side(
        lambda: steps_per_second(lambda: _time_steps(env, actions)),
        lambda: steps_per_second(lambda: _time_bare_steps(env, commands)),
        3 * repeat,
    )
    env.close()
    return Row(
        "one environment",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.0%}",
        ">= 60 %",
        pair.ratio >= 0.6,
        "bare: the same motor commands are given, but only the stepSimulation calls are timed",
    )


def _random_actions(steps: int) -> NDArray[np.float32]:
    return np.random.default_rng(0).uniform(-1, 1, (steps, 7)).astype(np.float32)


def _recorded_commands(env: Any, actions: NDArray[np.float32]) -> Commands:
    """Return the motor commands that an episode gives in each step, to be given again without the task."""
    commands: Commands = []
    with _watched_motors(commands):
        env.reset(seed=0)
        for action in actions:
            commands.append([])
            env.step(action)
    return commands


@contextmanager
def _watched_motors(commands: Commands) -> Iterator[None]:
    motors = {name: call for name, call in vars(pybullet).items() if name.startswith("setJointMotorControl")}

    def watched(call: Any) -> Any:
        def command(*args: Any, **kwargs: Any) -> None:
            if commands:
                commands[-1].append(lambda: call(*args, **kwargs))
            call(*args, **kwargs)

        return command

    try:
        for name, call in motors.items():
            setattr(pybullet, name, watched(call))
        yield
    finally:
        for name, call in motors.items():
            setattr(pybullet, name, call)


def _time_steps(env: Any, actions: NDArray[np.float32]) -> float:
    env.reset(seed=0)
    began = time.perf_counter()
    for action in actions:
        env.step(action)
    return time.perf_counter() - began


def _time_bare_steps(env: Any, commands: Commands) -> float:
    env.reset(seed=0)
    seconds = 0.0
    for step in commands:
        for command in step:
            command()
        began = time.perf_counter()
        pybullet.stepSimulation(physicsClientId=env.sim.client)
        seconds += time.perf_counter() - began
    return seconds


def reset(repeat: int) -> Row:
    """Count `reset` after some steps, against emptying the world and loading its models again."""
    env = rlctl.make(TASK)
    client = pybullet.connect(pybullet.DIRECT)
    pair = side_by_side(
        lambda: float(np.median([_time_reset(env, seed) for seed in range(50)])),
        lambda: float(np.median([_time_reload(client) for _ in range(5)])),
        3 * repeat,
    )
    same = np.array_equal(_episode(env), _episode(rlctl.make(TASK)))
    env.close()
    pybullet.disconnect(client)
    faster = 1 / pair.ratio
    return Row(
        "reset",
        f"{pair.ours * 1e6:,.0f} us",
        f"{pair.theirs * 1e3:,.1f} ms",
        f"{faster:,.0f}x",
        ">= 100x, reproducible",
        faster >= 100 and same,
        f"an episode after {150 * repeat:,} others is {'' if same else 'NOT '}bit-equal to a fresh world's",
    )


def _time_reset(env: Any, seed: int) -> float:
    env.reset(seed=seed)
    for action in _random_actions(5):
        env.step(action)
    began = time.perf_counter()
    env.reset(seed=seed + 1)
    return time.perf_counter() - began


def _time_reload(client: int) -> float:
    began = time.perf_counter()
    pybullet.resetSimulation(physicsClientId=client)
    pybullet.setAdditionalSearchPath(str(MODELS), physicsClientId=client)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    pybullet.loadURDF("plane.urdf", physicsClientId=client)
    pybullet.loadURDF("kuka_iiwa.urdf", useFixedBase=True, physicsClientId=client)
    return time.perf_counter() - began


def _episode(env: Any) -> NDArray[np.float32]:
    first, _ = env.reset(seed=7)
    return np.stack([first, *(env.step(action)[0] for action in _random_actions(env.max_steps))])


def many_environments(repeat: int) -> Row:
    """Count environment steps, resets included, of `Workers` and of SB3's `SubprocVecEnv`."""
    workers = Workers(EnvSpec(TASK), MANY)
    workers.reset({env: env for env in range(MANY)})
    workers.set_policy(make_policy(workers))
    processes = SubprocVecEnv([lambda: rlctl.make(TASK)] * FEW)
    processes.reset()
    rounds = 120  # steps of all environments
    uniform, envs = Exploration(warmup=True), range(MANY)
    actions = np.random.default_rng(0).uniform(-1, 1, (rounds, FEW, 7)).astype(np.float32)

    def play() -> None:
        workers.start_playing(Play(rounds, dict.fromkeys(envs, -1), dict.fromkeys(envs, 1), exploration=uniform))
        workers.finish_playing()

    def step_processes() -> None:
        for action in actions:
            processes.step(action)

    pair = side_by_side(
        lambda: MANY * rounds / _seconds(play), lambda: FEW * rounds / _seconds(step_processes), 2 * repeat + 1
    )
    workers.close()
    processes.close()
    return Row(
        "64 environments",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        ">= 2.5x",
        pair.ratio >= 2.5,
        f"Workers on {available_cores()} cores against SubprocVecEnv x {FEW}, uniform actions, resets included",
    )


def _seconds(run: Callable[[], None]) -> float:
    began = time.perf_counter()
    run()
    return time.perf_counter() - began
