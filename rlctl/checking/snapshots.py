"""Snapshots: the state of an environment within an episode, put back without a reset.

Everything is put back in place, so that references between objects stay what they were. What cannot be copied, such as
a viewer or a motor's target in PyBullet, is left as it is: `Snapshot.is_faithful` tells whether that matters.
"""

import collections
import contextlib
import random
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.instance import Instance
from rlctl.checking.transitions import flatten_floats
from rlctl.checking.values import is_own_object, is_task
from rlctl.environments.bullet_clients import ClientCalls

MOST_NUMBERS, MOST_OBJECTS = 1_000_000, 5_000  # of an array; and so many objects at most
TRIED_STEPS = 3  # that are repeated, to see whether a snapshot has everything
SLOW_S = 0.004  # of a reset: faster ones need no snapshot
SAME = 1e-5  # of the numbers, or of 1: what engines keep of contacts
_Restore = Callable[[], None]


class Snapshot:
    """The state of an instance at the moment at which this is made; valid until the instance is reset."""

    def __init__(self, instance: Instance) -> None:
        """Raises `LookupError` where the state cannot be copied."""
        if is_task(instance.env):
            raise LookupError("a task has its state in its simulation")
        self._resets = instance.resets
        self._instance = instance
        self._restores: list[_Restore] = []
        self._states: list[tuple[ClientCalls, int]] = []
        self._seen: set[int] = set()
        env = instance.env
        while hasattr(env, "__dict__"):
            self._add_object(env)
            env = vars(env).get("env")
        for client in instance.find_clients():
            self._add_client(ClientCalls(client))

    @property
    def is_valid(self) -> bool:
        """Whether the instance is still in the same episode."""
        return self._resets == self._instance.resets

    def restore(self) -> None:
        """Put the state back."""
        for restore in self._restores:
            restore()

    def forget(self) -> None:
        """Free what engines hold for it."""
        for p, state in self._states if self.is_valid else ():
            with contextlib.suppress(p.error):  # a simulation that the environment has emptied
                p.removeState(state)

    def is_faithful(self, episode: EpisodePlayer) -> bool:
        """Say whether some steps of an episode that begin here are the same when they are repeated. The state is put
        back."""
        tries = []
        for _ in range(2):
            self.restore()
            player = EpisodePlayer(self._instance, episode.seed, "repeated", max_steps=TRIED_STEPS)
            player.resume(0)
            rows = []
            while not player.ended:
                moment = player.step()
                rows.append(np.append(flatten_floats(self._instance.leaves, moment.observation), moment.reward_number))
            tries.append(np.array(rows))
        self.restore()
        one, two = tries
        return one.shape == two.shape and np.allclose(one, two, rtol=SAME, atol=SAME, equal_nan=True)

    def _add_client(self, p: ClientCalls) -> None:
        state = p.saveState()
        self._states.append((p, state))
        self._restores.append(lambda: p.restoreState(state))

    def _add_object(self, value: Any) -> None:
        """Note the attributes of an object."""
        self._seen.add(id(value))
        self._add_dict(vars(value))

    def _add(self, value: Any) -> None:
        """Note a value, if it can change in place."""
        if isinstance(value, str | bytes | int | float | complex | np.generic | None) or id(value) in self._seen:
            return
        self._seen.add(id(value))
        if len(self._seen) > MOST_OBJECTS:
            raise LookupError("it holds too many objects")
        mujoco = sys.modules.get("mujoco")
        if isinstance(value, np.ndarray):
            self._add_array(value)
        elif isinstance(value, dict):
            self._add_dict(value)
        elif isinstance(value, list | collections.deque | set):
            self._add_collection(value)
        elif isinstance(value, tuple):
            for item in value:
                self._add(item)
        elif isinstance(value, np.random.Generator | np.random.RandomState | random.Random):
            self._add_generator(value)
        elif mujoco is not None and isinstance(value, mujoco.MjData):
            kept = mujoco.MjData(value.model)
            mujoco.mj_copyData(kept, value.model, value)
            self._restores.append(lambda: mujoco.mj_copyData(value, value.model, kept))
        elif is_own_object(value):
            self._add_object(value)

    def _add_array(self, value: NDArray[Any]) -> None:
        if value.dtype.kind not in "biufc" or value.size > MOST_NUMBERS or not value.flags.writeable:
            return
        kept = value.copy()

        def restore() -> None:
            value[...] = kept

        self._restores.append(restore)

    def _add_dict(self, value: dict[Any, Any]) -> None:
        kept = dict(value)

        def restore() -> None:
            value.clear()
            value.update(kept)

        self._restores.append(restore)
        for item in kept.values():
            self._add(item)

    def _add_collection(self, value: Any) -> None:
        kept = list(value)

        def restore() -> None:
            value.clear()
            (value.update if isinstance(value, set) else value.extend)(kept)

        self._restores.append(restore)
        for item in kept:
            self._add(item)

    def _add_generator(self, value: Any) -> None:
        if isinstance(value, np.random.Generator):
            bits, state = value.bit_generator, value.bit_generator.state

            def restore() -> None:
                bits.state = state

        elif isinstance(value, np.random.RandomState):
            old = value.get_state()

            def restore() -> None:
                value.set_state(old)

        else:
            known = value.getstate()

            def restore() -> None:
                value.setstate(known)

        self._restores.append(restore)


class Beginnings:
    """Keeps the state after the first steps of an episode, for those that begin with the same steps: where a reset is
    slow."""

    def __init__(self) -> None:
        self._snapshot: Snapshot | None = None
        self._key: Any = None
        self._values: dict[str, Any] = {}
        self._is_useful: bool | None = None  # None before the first was tried

    def keep(self, episode: EpisodePlayer, key: Any, values: Mapping[str, Any]) -> None:
        """Note the present state, and values that belong to it."""
        if self._snapshot is not None:
            self._snapshot.forget()
            self._snapshot = None
        is_first = self._is_useful is None
        if is_first:
            self._is_useful = (episode.instance.progress.mean_s("reset", fewest=1) or 0.0) > SLOW_S
        if not self._is_useful:
            return
        try:
            snapshot = Snapshot(episode.instance)
            self._is_useful = not is_first or snapshot.is_faithful(episode)
        except LookupError:
            self._is_useful = False
        if self._is_useful:
            self._snapshot, self._key, self._values = snapshot, key, dict(values)

    def restore(self, key: Any) -> dict[str, Any] | None:
        """Put the state back that was kept for a key, and return its values; None if there is none."""
        if self._snapshot is None or self._key != key or not self._snapshot.is_valid:
            return None
        self._snapshot.restore()
        return dict(self._values)
