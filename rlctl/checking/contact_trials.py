"""Plays episodes in which the environment gets other contacts from its engine than there are."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiments.worlds import WatchedWorlds
from rlctl.checking.instance import Instance
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.values import find_numbers, flatten, list_parts
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Array, Link
from rlctl.environments.bullet_calls import Contacts
from rlctl.environments.simulations import find_mujoco

SEEDS = (FIRST_SEED + 1, FIRST_SEED + 2)
STEPS, FEWEST_STEPS = 15, 4  # of an episode; those in which the environment was shown contacts
BulletContacts = Callable[[Sequence[int | None], Contacts], Contacts]
"""Returns other contacts for what getContactPoints was asked for, and what it found."""
MujocoContacts = Callable[[Array], Array]
"""Returns other pairs of geoms for those of the contacts. Shapes (n, 2) and (at most n, 2)."""


@dataclasses.dataclass(frozen=True)
class PlayedContacts:
    """What the steps of some episodes returned."""

    names: list[str]
    rows: list[list[Array]]  # by episode and step: observation, numbers of the info, reward and `terminated`
    asked: list[list[bool]]  # by episode and step: whether the engine had a contact that was shown

    def pair(self, other: "PlayedContacts") -> tuple[Array, Array] | None:
        """Return the steps of both in which this one had contacts, shape (steps, columns) each; None for few, and where
        the other one has other columns."""
        pairs = [
            (row, of_other)
            for rows, asked, others in zip(self.rows, self.asked, other.rows, strict=True)
            for row, is_asked, of_other in zip(rows, asked, others, strict=False)
            if is_asked
        ]
        if len({row.shape for pair in pairs for row in pair}) != 1:
            return None
        first, second = np.array(pairs).transpose(1, 0, 2)
        ended = any(row[-1] for row in first)
        return (first, second) if ended or len(first) >= FEWEST_STEPS else None


def _play(instance: Instance, shown: Callable[[], bool], actions: str) -> PlayedContacts:
    """Play episodes; `shown` says whether there were contacts since it was called last."""
    played = PlayedContacts([], [], [])
    for seed in SEEDS:
        played.rows.append([])
        played.asked.append([])
        for moment in EpisodePlayer(instance, seed, actions, max_steps=STEPS):
            is_shown = shown()
            if moment.step == 0:
                continue
            info = dict(find_numbers(moment.info)) if isinstance(moment.info, dict) else {}
            observed = np.nan_to_num(flatten(moment.observation).astype(np.float64))
            numbers = np.nan_to_num([*info.values(), moment.reward_number, float(moment.flags[0])])
            played.rows[-1].append(np.concatenate([observed, numbers]))
            played.asked[-1].append(is_shown)
            if not played.names:
                parts = list_parts(moment.observation)
                played.names.extend(f"{name}[{number}]" for name, size in parts for number in range(size))
                played.names.extend([*(f"info[{name!r}]" for name in info), "the reward", "the end of the episode"])
    return played


def play_in_bullet(
    watched: WatchedWorlds, world: LoggedWorld, other: BulletContacts, actions: str = "zero"
) -> PlayedContacts:
    """Play episodes in PyBullet with other contacts of a world."""
    was_shown = False

    def change(asked: Sequence[int | None], contacts: Contacts) -> Contacts:
        nonlocal was_shown
        if asked[4] != world.world.client:
            return contacts
        shown = other(asked, contacts)
        was_shown |= bool(shown)
        return shown

    def read_shown() -> bool:
        nonlocal was_shown
        is_shown, was_shown = was_shown, False
        return is_shown

    watched.calls.change_contacts = change
    try:
        return _play(watched.instance, read_shown, actions)
    finally:
        watched.calls.change_contacts = None


def play_in_mujoco(watched: WatchedWorlds, other: MujocoContacts, actions: str = "zero") -> PlayedContacts:
    """Play episodes in MuJoCo with other contacts, whose forces stay."""
    simulation = find_mujoco(watched.instance.env)
    assert simulation is not None  # it was logged
    data_of_env, was_shown = simulation[1], False

    def change(_: Any, data: Any) -> None:
        nonlocal was_shown
        if data is not data_of_env or not data.ncon:
            return
        shown = other(data.contact.geom.copy())
        was_shown = bool(len(shown))
        data.ncon = len(shown)
        if was_shown:
            data.contact.geom[:] = shown
            data.contact.geom1[:], data.contact.geom2[:] = shown.T

    calls = watched.mujoco_calls
    calls.after_step, calls.after_forward = change, change
    try:
        return _play(watched.instance, lambda: was_shown, actions)
    finally:
        calls.after_step, calls.after_forward = type(calls).after_step, type(calls).after_forward


def make_contacts(asked: Sequence[int | None], bump: tuple[Link, Link]) -> Iterator[tuple[Any, ...]]:
    """Yield a contact as getContactPoints returns it, if it has the bodies and links that are asked for."""
    for one, two in (bump, bump[::-1]):
        if is_asked(asked, one, two):
            yield make_contact(one, two, distance=-1e-3, force=10.0)
            return


def is_asked(asked: Sequence[int | None], one: Link, two: Link) -> bool:
    """Say whether a query for bodyA, bodyB, linkIndexA and linkIndexB returns contacts of two links."""
    given = (one[0], two[0], one[1], two[1])
    return all(wanted in (None, value) for wanted, value in zip(asked, given, strict=False))


def make_contact(one: Link, two: Link, *, distance: float, force: float, friction: float = 0.0) -> tuple[Any, ...]:
    """Return a contact of two links as getContactPoints does, with a distance [m] and forces [N]."""
    nothing, up = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    forces = (distance, force, friction, nothing, friction, nothing)
    return (0, one[0], two[0], one[1], two[1], nothing, nothing, up, *forces)
