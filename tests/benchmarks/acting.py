"""How fast workers play with a policy, against stepping all environments by turns with a batched policy in torch."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tarfile
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.spec import EnvSpec
from rlctl.play.collect import play_episodes
from rlctl.play.messages import Play
from rlctl.play.seeds import Stream, episode_seed
from rlctl.play.workers import Workers, available_cores
from rlctl.policy.actor import Exploration
from rlctl.policy.file import PolicyFile, PolicyInfo
from tests.benchmarks.row import Row, side_by_side

MANY = 64
STEPS = 40  # of each environment in a segment
HIDDEN = 64
EPISODES = 100
LEAST = 1.2  # two thirds of a worker's time are PyBullet's own calls, which acting in the workers cannot shorten
SAMPLES = Exploration(stochastic=True)
BEFORE = "85f4e6aae9f677b6110d60fa1f6ccd0e54f971b8"
"""The last commit whose workers stepped all environments by turns: from then on the figure to compare with is fixed."""
PROGRAM = Path(__file__).with_name("stepping_by_turns.py")


def reach(repeat: int) -> Row:
    """Count environment steps of `reach`, resets included."""
    return _row("reach", LEAST, repeat)


def half_cheetah(repeat: int) -> Row:
    """Count environment steps of `half-cheetah`, resets included."""
    return _row("half-cheetah", LEAST, repeat)


def evaluation(repeat: int) -> Row:
    """Count environment steps of 100 whole episodes of `reach`, as `rlctl eval` plays them."""
    workers = Workers(EnvSpec("reach"), available_cores())
    workers.set_policy(make_policy(workers))
    turns = _Turns("reach")

    def play() -> float:
        began = time.perf_counter()
        steps = sum(episode.result.length for episode in play_episodes(workers, range(EPISODES)))
        return steps / (time.perf_counter() - began)

    pair = side_by_side(play, lambda: turns.play(2), 2 * repeat + 1)
    workers.close()
    turns.close()
    return Row(
        "evaluating reach",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        f">= {LEAST}x",
        pair.ratio >= LEAST,
        f"{EPISODES} episodes on {available_cores()} cores, each whole inside a worker, against one step of {MANY} "
        "environments at a time and the policy in torch",
    )


def per_step(repeat: int) -> Row:
    """Count what a step costs with 8 and with 256 environments."""
    few, many = (_Player(Workers(EnvSpec("reach"), n_envs)) for n_envs in (8, 256))
    pair = side_by_side(lambda: few.play(8), lambda: many.play(1), 2 * repeat + 1)
    few.workers.close()
    many.workers.close()
    return Row(
        "256 against 8 environments",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ours:,.0f} steps/s",
        f"{1 / pair.ratio:.2f}x",
        ">= 0.9x",
        1 / pair.ratio >= 0.9,
        f"environment steps of reach with a policy on {available_cores()} cores: 256 environments against 8",
    )


def _row(task: str, target: float, repeat: int) -> Row:
    workers = Workers(EnvSpec(task), MANY)
    player = _Player(workers)
    turns = _Turns(task)
    pair = side_by_side(lambda: player.play(2), lambda: turns.play(2), 2 * repeat + 1)
    workers.close()
    turns.close()
    return Row(
        f"playing {task}",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        f">= {target}x",
        pair.ratio >= target,
        f"{MANY} environments on {available_cores()} cores with a {HIDDEN}-{HIDDEN} policy: segments of {STEPS} steps "
        "inside the workers, against one step of all environments at a time and the policy in torch",
    )


class _Player:
    """Segments, as on-policy training plays them."""

    def __init__(self, workers: Workers) -> None:
        self.workers = workers
        self._policy = make_policy(workers)
        self._started = [0] * workers.n_envs
        self._begin()

    def _begin(self) -> None:
        seeds = {env: episode_seed(0, Stream.TRAIN, env, 0) for env in range(self.workers.n_envs)}
        self._play(seeds)

    def _play(self, begin: dict[int, int]) -> None:
        self.workers.set_policy(self._policy)
        self.workers.start_playing(Play(STEPS, begin, dict(enumerate(self._started)), exploration=SAMPLES))
        for result in self.workers.finish_playing():
            self._started[result.env] += 1

    def play(self, segments: int) -> float:
        """Return steps per second."""
        began = time.perf_counter()
        for _ in range(segments):
            self._play(dict.fromkeys(range(self.workers.n_envs), -1))
        return segments * STEPS * self.workers.n_envs / (time.perf_counter() - began)


class _Turns:
    """All environments step by step with a batched policy in torch: rlctl as it was before workers acted."""

    def __init__(self, task: str) -> None:
        self._folder = tempfile.TemporaryDirectory()
        root, repository = Path(self._folder.name), Path(__file__).parents[2]
        archive = subprocess.run(
            ["git", "archive", BEFORE, "rlctl", "plugins"], cwd=repository, stdout=subprocess.PIPE, check=True
        )
        with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
            files.extractall(root, filter="data")
        self._process = subprocess.Popen(
            [sys.executable, str(PROGRAM), task, str(MANY), str(STEPS), str(HIDDEN)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(root), str(root / "plugins")])},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._read()

    def _read(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def play(self, segments: int) -> float:
        """Return steps per second."""
        print(segments, file=self._process.stdin, flush=True)
        return float(self._read())

    def close(self) -> None:
        """End its processes."""
        self._process.communicate()
        self._folder.cleanup()


_LAYERS = ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net")


def make_policy(workers: Workers) -> PolicyFile:
    """Return a policy of random numbers."""
    rng = np.random.default_rng(0)
    observations, actions = (int(np.prod(space.shape or ())) for space in workers.info.spaces())
    sizes = [observations, HIDDEN, HIDDEN, actions]
    tensors: dict[str, NDArray[Any]] = {"policy/log_std": np.full(actions, np.log(0.5), np.float32)}
    for name, before, after in zip(_LAYERS, sizes[:-1], sizes[1:], strict=True):
        tensors[f"policy/{name}.weight"] = (0.1 * rng.standard_normal((after, before))).astype(np.float32)
        tensors[f"policy/{name}.bias"] = np.zeros(after, np.float32)
    tensors |= {"normalize//mean": np.zeros(observations), "normalize//var": np.ones(observations)}
    info = PolicyInfo(
        algo="ppo",
        policy="MlpPolicy",
        env=workers.info,
        spec=workers.spec,
        normalized_keys=[""],
        clip_observation=10.0,
    )
    return PolicyFile(info, tensors)
