"""RL830: contacts compared in the wrong order."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.contact_trials import PlayedContacts, play_in_bullet, play_in_mujoco
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.instance import EnvironmentRaised
from rlctl.checking.mujoco_worlds import MujocoStateReader
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Array
from rlctl.environments.bullet_calls import Contacts

RULE = Rule(
    "RL830",
    "contacts compared in the wrong order",
    Severity.WARNING,
    meaning="""
        The environment looks for a pair of parts among all contacts, in one order, and the engine gives the pair in the
        other one: the contact is there and is never seen. Flags of feet or fingers are always 0, a reward for contacts
        is never paid, and a fall ends nothing. The check exchanged the two sides of each contact: then the values
        changed, and without any contact they did not. MuJoCo orders the geoms of a contact by their types, PyBullet
        the bodies by its own lists.
    """,
    fix="""
        Compare both orders, as in {contact.geom1, contact.geom2} == {foot, floor}; in PyBullet give both bodies to
        getContactPoints.
    """,
)

LEAST_CHANGE = 1e-6  # of what the order changes, relative to the value or to 1
FAR_ABOVE = 100.0  # times what the same episodes differ by
ACTIONS = ("zero", "random")


@judges_worlds(RULE, place=95)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for world in watched.worlds:
        is_asked = _reads_in_mujoco(watched, world) or _asks_for_all_in_bullet(watched, world)
        if is_asked and watched.instance.accepts_seed and not watched.instance.context.budget.is_over():
            try:
                yield from _exchange_sides(watched, world)
            except EnvironmentRaised:  # an episode that was logged raised it too, or it needs what is left out
                return


def _reads_in_mujoco(watched: WatchedWorlds, world: LoggedWorld) -> bool:
    return isinstance(world.reader, MujocoStateReader) and watched.mujoco_calls.reads_contacts


def _asks_for_all_in_bullet(watched: WatchedWorlds, world: LoggedWorld) -> bool:
    queries = [query for query in watched.calls.queries.values() if query.client == world.world.client]
    return any(query.contacts and query.bodies == (-1, -1) for query in queries)


def _exchange_sides(watched: WatchedWorlds, world: LoggedWorld) -> Iterator[RuleFinding]:
    """Yield what is the same with the engine's contacts and without any, and differs if their sides are exchanged."""
    is_mujoco = isinstance(world.reader, MujocoStateReader)
    for actions in ACTIONS:
        if is_mujoco:
            shown, again = (play_in_mujoco(watched, lambda pairs: pairs, actions) for _ in range(2))
            exchanged = play_in_mujoco(watched, lambda pairs: pairs[:, ::-1], actions)
        else:
            shown, again = (play_in_bullet(watched, world, lambda _, contacts: contacts, actions) for _ in range(2))
            exchanged = play_in_bullet(watched, world, _exchange, actions)
        noise = _measure_differences(shown, again)
        seen = _find_different(shown, exchanged, noise)
        if not seen:
            continue
        if is_mujoco:
            without = play_in_mujoco(watched, lambda pairs: pairs[:0], actions)
        else:
            without = play_in_bullet(watched, world, lambda *_: (), actions)
        needed = _find_different(shown, without, noise)
        unseen = [column for column in seen if column not in needed]
        if unseen:
            yield _describe([shown.names[column] for column in unseen])
            return


def _exchange(asked: Sequence[int | None], contacts: Contacts) -> Contacts:
    """Exchange the sides of each contact; where the call names a body, that sets the order."""
    if asked[0] not in (None, -1) or asked[1] not in (None, -1):
        return contacts
    return tuple((one[0], one[2], one[1], one[4], one[3], one[6], one[5], *one[7:]) for one in contacts)


def _measure_differences(one: PlayedContacts, other: PlayedContacts) -> Array:
    """Return the largest difference of each column, relative to the value or to 1; NaN where there is nothing to
    compare. Shape (columns,)."""
    largest = np.full(len(one.names), np.nan)
    for rows, others in zip(one.rows, other.rows, strict=True):
        for row, of_other in zip(rows, others, strict=False):
            if row.shape == of_other.shape == largest.shape:
                largest = np.fmax(largest, np.abs(row - of_other) / np.maximum(1.0, np.abs(row)))
    return largest


def _find_different(one: PlayedContacts, other: PlayedContacts, noise: Array) -> list[int]:
    allowed = np.maximum(LEAST_CHANGE, FAR_ABOVE * noise)
    return np.flatnonzero(_measure_differences(one, other) > allowed).tolist()


def _describe(names: Sequence[str]) -> RuleFinding:
    what = f"{list_names(names, 4)} {'do' if len(names) > 1 else 'does'} not see contacts that are there"
    message = f"{what}: without any contact nothing changes, and with the two sides of each contact exchanged it does"
    return RuleFinding(RULE, message, {"element": names[0], "elements": list(names[:8])})
