"""Finds environments that share a PyBullet world with the others of their process, so that each needs its own process.

A call without physicsClientId goes to client 0, the world of the process's first environment.
"""

import contextlib
import os
import re
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.environments.bullet_calls import BulletCall, record_calls
from rlctl.environments.bullet_clients import find_clients
from rlctl.environments.gym_worlds import GymWorlds
from rlctl.environments.registry import is_task
from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.play.messages import SharedWorld
from rlctl.play.playing import Playing, Worlds
from rlctl.play.seeds import Stream, episode_seed
from rlctl.policy.named_actors import make_actor
from rlctl.storage.untrusted import measure_free_memory

_HARMLESS = re.compile(r"setAdditionalSearchPath|\w*Debug\w*|get(Keyboard|Mouse)Events")
"""Functions that neither change nor read what a world simulates."""
_STEPS = 3


_FIX = "pass physicsClientId=self.client to every call of PyBullet"
_MEMORY_SHARE = 0.8  # of the free memory that the processes of environments may take together


def explain_processes(world: SharedWorld, n_envs: int) -> str:
    """Return a warning that each environment has a process of its own, and how to avoid it."""
    why = f"{world.how} (RL808), so environments in one process would share one PyBullet world"
    return f"warning: {why}: each of the {n_envs:,} has its own process, which takes more memory; to avoid it {_FIX}"


def check_memory(task: str, world: SharedWorld, n_envs: int) -> None:
    """Raise `TaskError` if the memory that is free is too little for a process per environment."""
    free = measure_free_memory()
    if free is None:
        return
    fit = max(1, int(_MEMORY_SHARE * free / max(world.process_bytes, 1)))
    if n_envs > fit:
        raise TaskError(
            f"task {task!r}: {world.how} (RL808), so environments in one process would share one PyBullet world; each "
            f"needs its own process, and the free memory is enough for {fit:,}, not for {n_envs:,}\n"
            f"{_FIX}, or use --n-envs {fit}"
        )


def _read_own_memory() -> int:
    """Return the resident memory of this process [bytes]; 0 where that is not known."""
    with contextlib.suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def make_watched(spec: EnvSpec, teacher: EnvSpec | None = None) -> tuple[Worlds, SharedWorld | None]:
    """Build one world and try it for a few steps; return it, and how it shares its world with others, or None.

    Tasks of rlctl and environments without PyBullet are only built. An error in the trial is left to the first episode.
    """
    if is_task(spec.constructor()):
        return spec.make_worlds(1, teacher=teacher), None
    before = set(find_clients())
    with record_calls(with_results=()) as calls:
        worlds = spec.make_worlds(1, teacher=teacher)
    assert isinstance(worlds, GymWorlds)  # those of a task are above
    if "pybullet" not in sys.modules or not {*find_clients(), *before}:
        return worlds, None
    with record_calls(with_results=()) as later:
        _try(worlds)
    has_own = bool(set(find_clients()) - before)
    how = _find_shared(worlds.env, calls.without_client | later.without_client, has_own=has_own)
    return worlds, SharedWorld(how, _read_own_memory()) if how else None


def _find_shared(env: Any, without_client: Collection[BulletCall], *, has_own: bool) -> str:
    found = sorted(call for call in without_client if not _HARMLESS.fullmatch(call.name))
    if found:
        return f"{found[0].place} calls {found[0].name} without physicsClientId"
    if module := _find_bare_imports(env):
        return f"{module} imports functions of PyBullet by name, so that their physicsClientId is not known"
    return "" if has_own else "it has no PyBullet client of its own"


def _try(worlds: Worlds) -> None:
    seed, first = episode_seed(0, Stream.CHECK, 0, 0), np.zeros(1, np.int64)
    playing = Playing(worlds)
    try:
        observation = playing.begin(first, [seed])
        for number, _ in enumerate(
            playing.play(make_actor("random", worlds.action_space), first, observation), start=1
        ):
            if number == _STEPS:
                return
    except BaseException:  # the first episode raises it again, with its seed and step
        return


def _find_bare_imports(env: Any) -> str:
    """Return the module of an environment's class that has functions of PyBullet as globals; empty if none has."""
    functions = {id(value) for value in vars(sys.modules["pybullet"]).values() if callable(value)}
    for base in type(getattr(env, "unwrapped", env)).__mro__:
        members = vars(sys.modules.get(base.__module__, object))
        if any(id(value) in functions for value in members.values()):
            return base.__module__
    return ""
