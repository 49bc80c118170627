"""RL825: any contact counts."""

import collections
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.contact_trials import PlayedContacts, make_contacts, play_in_bullet, play_in_mujoco
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.instance import EnvironmentRaised
from rlctl.checking.mujoco_worlds import MujocoStateReader
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Array, Link, Pair
from rlctl.environments.bullet_calls import Contacts

RULE = Rule(
    "RL825",
    "any contact counts",
    Severity.WARNING,
    meaning="""
        A flag of the observation, a part of the reward or an end of the episode depends on whether anything touches,
        and something always does: feet on the ground, an object on the table. It never changes, whatever the robot
        bumps into. The engine's contacts are left out, and replaced by others, to see it.
    """,
    fix="""
        Ask for the pair that is meant: give bodyB, and links, to getContactPoints; in MuJoCo compare both geoms of
        each data.contact with those that are meant, instead of data.ncon.
    """,
)

RESTS = 0.8  # of all looks after a reset, in which two bodies touch
OFTEN = 0.3  # of all looks, in which two of their links do
LEAST_CHANGE = 1e-3  # of what contacts change
SAME = 1e-6  # relative
MOST_PARTS = 6  # bumps that are tried


@judges_worlds(RULE, place=94)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    if not watched.instance.accepts_seed or watched.instance.context.budget.is_over():
        return
    for world in watched.worlds:
        resting = _find_resting(world)
        is_asked = _asks_in_bullet(watched, world) or _asks_in_mujoco(watched, world)
        bumps = _list_bumps(world, resting) if resting and is_asked else []
        if isinstance(world.reader, MujocoStateReader):
            bumps = [bump for bump in bumps if all(world.reader.find_geom(link) is not None for link in bump)]
        if not bumps:
            continue
        try:
            yield from _try_bumps(watched, world, resting, bumps)
        except EnvironmentRaised:  # an episode that was logged raised it too, or it needs what is left out
            return


def _find_resting(world: LoggedWorld) -> set[Pair]:
    """Return the pairs of links with which two bodies, or a body and itself, touch in nearly all looks: feet that take
    turns, too. Without robots that hold something, and without what touches now and then."""
    looks = [pairs for log in world.logs for pairs in log.touching[1:]]
    robots = {body.id for body in world.world.bodies if body.joints}
    free = {body.id for body in world.world.bodies if body.is_free}
    links = collections.Counter(pair for pairs in looks for pair in pairs)
    bodies = collections.Counter(both for pairs in looks for both in {_get_bodies(pair) for pair in pairs})
    resting = set()
    for pair, count in links.items():
        both = _get_bodies(pair)
        holds = len(both) == 2 and bool(both & robots) and both <= robots | free
        if not holds and bodies[both] >= RESTS * len(looks) and count >= OFTEN * len(looks):
            resting.add(pair)
    return resting


def _get_bodies(pair: Pair) -> frozenset[int]:
    return frozenset(body for body, _ in pair)


def _asks_in_bullet(watched: WatchedWorlds, world: LoggedWorld) -> bool:
    """Say whether the environment asks PyBullet for contacts without naming both bodies, and gets some."""
    for query in watched.calls.queries.values():
        if query.client == world.world.client and query.contacts and -1 in query.bodies:
            return True
    return False


def _asks_in_mujoco(watched: WatchedWorlds, world: LoggedWorld) -> bool:
    return isinstance(world.reader, MujocoStateReader) and watched.mujoco_calls.reads_contacts


def _list_bumps(world: LoggedWorld, resting: set[Pair]) -> list[tuple[Link, Link]]:
    """Return pairs of links that do not touch, and that a bump may be of: the robot with what rests on something, and a
    link of the robot that does not stand on anything with another body."""
    bodies, touched = world.world.bodies, {link for pair in resting for link in pair}
    robots = [body for body in bodies if body.joints] or [body for body in bodies if body.is_free]
    bumps: list[tuple[Link, Link]] = []
    for robot in robots:
        links = [(robot.id, number - 1) for number in range(len(robot.links))]
        idle = [link for link in reversed(links) if link not in touched]
        mine = idle or links
        others = [body for body in bodies if body.id != robot.id]
        objects = [body for body in others if body.is_free and (body.id, -1) in touched]
        statics = [body for body in others if not body.is_free and not body.joints]
        away = [body for body in statics if (body.id, -1) not in touched]
        for other in [*objects, *away, *(statics if idle else [])]:
            bumps.append((mine[0], (other.id, -1)))
    return bumps[:MOST_PARTS]


def _try_bumps(
    watched: WatchedWorlds, world: LoggedWorld, resting: set[Pair], bumps: Sequence[tuple[Link, Link]]
) -> Iterator[RuleFinding]:
    """Yield what is the same with the contacts that are always there and with a bump, and differs without contacts."""
    play = _play_in_mujoco if isinstance(world.reader, MujocoStateReader) else _play_in_bullet
    standing = play(watched, world, resting, None)
    again = play(watched, world, resting, None)
    changed = _find_constant(standing, play(watched, world, set(), None), again)
    for bump in bumps if changed else ():
        bumped = play(watched, world, set(), bump)
        same = [column for column in changed if _is_same(standing, bumped, again, column)]
        if same:
            yield _describe(world, resting, bump, [(standing.names[column], changed[column]) for column in same])
            return


def _describe(
    world: LoggedWorld, resting: set[Pair], bump: tuple[Link, Link], found: Sequence[tuple[str, float]]
) -> RuleFinding:
    name = world.world.link_name
    pairs = sorted(resting, key=lambda pair: (pair[0][0] == pair[1][0], pair))
    stands = list_names([f"{name(max(pair))} on {name(min(pair))}" for pair in pairs], 3)
    what = list_names([text for text, _ in found], 4)
    change = f"{found[0][0]} differs by {found[0][1]:.4g}" if len(found) > 1 else f"it differs by {found[0][1]:.4g}"
    always = f"there is nearly always one ({stands}), and without any contact {change}"
    message = (
        f"{what} counts any contact: {always}; a contact of {name(bump[0])} with {name(bump[1])} alone is the same"
    )
    return RuleFinding(RULE, message, {"element": found[0][0], "elements": [text for text, _ in found][:8]})


def _find_constant(standing: PlayedContacts, without: PlayedContacts, again: PlayedContacts) -> dict[int, float]:
    """Return the columns in which all steps differ by the same amount without contacts, and the amount."""
    pairs, repeated = standing.pair(without), standing.pair(again)
    if pairs is None or repeated is None:
        return {}
    noise = np.abs(repeated[0] - repeated[1]).max(axis=0)
    differences = pairs[0] - pairs[1]
    size = np.abs(differences).min(axis=0)
    is_constant = np.ptp(differences, axis=0) <= 10 * noise + SAME * (1 + np.abs(pairs[0]).max(axis=0))
    columns = np.flatnonzero(is_constant & (size > np.maximum(LEAST_CHANGE, 20 * noise)))
    return {column: float(size[column]) for column in columns.tolist()}


def _is_same(standing: PlayedContacts, bumped: PlayedContacts, again: PlayedContacts, column: int) -> bool:
    pairs, repeated = standing.pair(bumped), standing.pair(again)
    if pairs is None or repeated is None:
        return False
    noise = np.abs(repeated[0] - repeated[1]).max(axis=0)[column]
    off = np.abs(pairs[0] - pairs[1])[:, column].max()
    return bool(off <= 10 * noise + SAME * (1 + np.abs(pairs[0][:, column]).max()))


def _play_in_bullet(
    watched: WatchedWorlds, world: LoggedWorld, kept: set[Pair], bump: tuple[Link, Link] | None
) -> PlayedContacts:
    def change(asked: Sequence[int | None], contacts: Contacts) -> Contacts:
        links = [((contact[1], contact[3]), (contact[2], contact[4])) for contact in contacts]
        pairs = zip(contacts, links, strict=True)
        shown = [contact for contact, pair in pairs if pair in kept or pair[::-1] in kept]
        shown += make_contacts(asked, bump) if bump is not None else ()
        return tuple(shown)

    return play_in_bullet(watched, world, change)


def _play_in_mujoco(
    watched: WatchedWorlds, world: LoggedWorld, kept: set[Pair], bump: tuple[Link, Link] | None
) -> PlayedContacts:
    reader = world.reader
    assert isinstance(reader, MujocoStateReader)
    geoms = [] if bump is None else [reader.find_geom(link) for link in bump]

    def change(pairs: Array) -> Array:
        if geoms:
            return np.array([geoms])
        links = [(reader.find_link(one), reader.find_link(two)) for one, two in pairs.tolist()]
        return pairs[[pair in kept or pair[::-1] in kept for pair in links]]

    return play_in_mujoco(watched, change)
