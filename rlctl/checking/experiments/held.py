"""The experiment `held`: keeps a robot that falls at its start, to see what an environment does as time goes by.

The engine is put back to the state after the reset before every step, and nothing acts: whatever changes is not
physics. Only robots are held of which no episode came to a time limit; the others have shown it.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer, zero_action
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.experiments.episodes import ENDLESS_STEPS, ENOUGH_EPISODES, EPISODES
from rlctl.checking.instance import Context, Instance
from rlctl.checking.mujoco_worlds import FREE
from rlctl.checking.records import FIRST_SEED, ChildMessage, Fact
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.transitions import flatten_floats
from rlctl.environments.bullet_clients import ClientCalls
from rlctl.environments.simulations import find_mujoco

STEPS, STEPS_WITHOUT_LIMIT = 450, 1_100  # of an episode that declares a time limit, and of any other
SEEDS = 3
WAYS = ((0.003, 0.002), (-0.003, -0.002))  # [m] in a step: nearer to any goal, but for one right beside them
SETTLED = 10  # steps, after which what is solved again and again no longer changes
STATE = ("qpos", "qvel", "act", "qacc_warmstart")  # not the time, which goes on
Rows = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class HeldEpisode:
    """An episode of T steps, in which the robot stayed where it was."""

    seed: int
    ended: str  # see `EpisodePlayer.ended`
    observed: Rows  # The numbers that are floats, of the reset and of each step. Shape (T + 1, elements)
    rewards: Rows  # Shape (T,)
    moves: bool  # whether it was carried along instead

    @property
    def is_uneventful(self) -> bool:
        """Whether time changes nothing: other episodes would show no more."""
        return self.ended == "steps" and not np.ptp(self.rewards[SETTLED:]).any()


@experiment("held", PROBE, 105, share=0.5, seeds_globals=True, alters=True)
def hold_robot(context: Context) -> Iterator[ChildMessage]:
    """Play a few episodes, each with another seed, in which the engine is put back before each step."""
    instance = context.instance
    if find_mujoco(instance.env) is None and not instance.find_clients():
        raise NotApplicable("no world of PyBullet or MuJoCo")
    longest = STEPS if instance.max_steps else STEPS_WITHOUT_LIMIT
    if context.longest_episode is None:  # the process of the experiment `episodes` ended
        _play_freely(context)
    if context.reached_limit or (context.longest_episode or 0) >= longest:
        raise NotApplicable("it lives long enough by itself")
    episodes: list[HeldEpisode] = []
    for number in range(SEEDS):
        episodes.append(_play(instance, FIRST_SEED + number, longest))
        if episodes[0].is_uneventful:
            break
    if len({len(episode.rewards) for episode in episodes}) == 1 and episodes[0].ended == "terminated":
        # Something counts steps: perhaps only those without progress.
        carried = [_play(instance, FIRST_SEED, longest, way) for way in WAYS]
        episodes += [episode for episode in carried if episode.moves]
    yield Fact("held", episodes)


def _play_freely(context: Context) -> None:
    """Play an episode of each kind, to see how long the robot lives by itself."""
    for number, kind in enumerate(EPISODES[:ENOUGH_EPISODES]):
        episode = EpisodePlayer(context.instance, FIRST_SEED + number, kind, number=number, max_steps=ENDLESS_STEPS)
        for _ in episode:
            pass
        context.note_episode(episode.steps, episode.ended)


def _play(instance: Instance, seed: int, longest: int, way: Sequence[float] = ()) -> HeldEpisode:
    with _Holder(instance, way) as holder:
        episode = EpisodePlayer(instance, seed, "held", max_steps=longest, sequence=holder.actions())
        observed, rewards = [], []
        for moment in episode:
            observed.append(flatten_floats(instance.leaves, moment.observation))
            if moment.step:
                rewards.append(moment.reward_number)
        if episode.ended == "time":
            raise NotJudged("time ran out")
        if holder.failed:
            raise NotJudged("the engine could not be put back")
    if len({row.size for row in observed}) > 1:
        raise NotJudged("the observation has more than one size (RL101)")
    return HeldEpisode(seed, episode.ended, np.array(observed), np.array(rewards), holder.moves)


class _Holder:
    """Puts the engines of an instance back, each time that an action is drawn."""

    def __init__(self, instance: Instance, way: Sequence[float]) -> None:
        """`way` is how far a base that is free is carried in a step [m], by x and y; empty to keep it."""
        self._instance, self._way = instance, np.array(way)
        self._restore: list[Callable[[], None]] = []
        self._forget: list[Callable[[], None]] = []
        self.failed = False
        self.moves = False  # whether a base is carried

    def __enter__(self) -> "_Holder":
        return self

    def __exit__(self, *_: object) -> None:
        for forget in self._forget:
            with contextlib.suppress(Exception):  # a client that the environment has closed
                forget()

    def actions(self) -> Iterator[Any]:
        """Yield the zero action without end; the first is drawn after the reset. Raises nothing of the engines: that
        would look as if the action space had raised it."""
        nothing = zero_action(self._instance.env.action_space)
        try:
            self._save()
        except Exception:
            self.failed = True
        while True:
            try:
                for restore in self._restore:
                    restore()
            except Exception:
                self.failed = True
            yield nothing

    def _save(self) -> None:
        if (simulation := find_mujoco(self._instance.env)) is not None:
            self._save_data(*simulation)
        for client in self._instance.find_clients():
            self._save_client(ClientCalls(client))
        self.failed |= not self._restore

    def _save_data(self, model: Any, data: Any) -> None:
        kept = {name: getattr(data, name).copy() for name in STATE}
        bases = model.jnt_qposadr[model.jnt_type == FREE].tolist() if self._way.size else []
        self.moves |= bool(bases)

        def restore() -> None:
            for base in bases:
                kept["qpos"][base : base + 2] += self._way
            for name, values in kept.items():
                getattr(data, name)[:] = values

        self._restore.append(restore)

    def _save_client(self, p: ClientCalls) -> None:
        state = p.saveState()
        bodies = [p.getBodyUniqueId(number) for number in range(p.getNumBodies())] if self._way.size else []
        bases = [body for body in bodies if p.getDynamicsInfo(body, -1)[0] > 0]
        self.moves |= bool(bases)
        carried = np.zeros(3)

        def restore() -> None:
            p.restoreState(state)
            carried[: self._way.size] += self._way
            for base in bases:
                position, orientation = p.getBasePositionAndOrientation(base)
                p.resetBasePositionAndOrientation(base, (carried + position).tolist(), orientation)

        self._restore.append(restore)
        self._forget.append(lambda: p.removeState(state))
