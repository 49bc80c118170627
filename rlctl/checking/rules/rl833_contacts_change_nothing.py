"""RL833: contacts change nothing."""

import dataclasses
import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.checking import contact_trials
from rlctl.checking.contact_trials import PlayedContacts, is_asked, make_contact, play_in_bullet
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.instance import EnvironmentRaised
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.world_logs import LoggedWorld
from rlctl.environments.bullet_calls import ContactQuery, Contacts

RULE = Rule(
    "RL833",
    "contacts change nothing",
    Severity.WARNING,
    meaning="""
        getContactPoints gives the environment contacts in most steps, and nothing that it returns depends on them: the
        check replaced them by none, by contacts of all links with a large force, and by both in turn. A flag, a reward
        or an end that should follow them is constant. Most often another field of a contact is compared, such as the
        distance (field 8) instead of the normal force (field 9), or the links of the other body.
    """,
    fix="""
        Look the field up in PyBullet's guide: 3 and 4 are the links of bodyA and bodyB, 8 is the distance, which is
        negative inside, and 9 the normal force.
    """,
)

OFTEN, FEWEST_CALLS = 0.5, 30  # contacts per call, and calls of a query that is judged
MOST_QUERIES = 3
FORCE, DISTANCE = 1e5, -0.01  # [N], [m]; more than any limit, and as deep as a soft contact
CHECKING = Path(contact_trials.__file__).parent
IN_TURN = 4  # calls without contacts, and as many with them
FIELDS = (
    "contactFlag", "bodyUniqueIdA", "bodyUniqueIdB", "linkIndexA", "linkIndexB", "positionOnA", "positionOnB",
    "contactNormalOnB", "contactDistance", "normalForce", "lateralFriction1", "lateralFrictionDir1",
    "lateralFriction2", "lateralFrictionDir2",
)  # fmt: skip
Asked = tuple[int | None, ...]
"""bodyA, bodyB, linkIndexA and linkIndexB of a query; None where left out."""


class _Contact(tuple[Any, ...]):
    """A contact that notes which of its fields are read."""

    read: set[int]

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, int):
            self.read.add(index % len(self))
        return super().__getitem__(index)


@dataclasses.dataclass
class _Shown:
    """What the environment is shown instead of the contacts that a query finds."""

    queries: Mapping[Asked, Contacts]  # with all contacts that there could be
    changed: Asked  # the query that is judged
    parts: Sequence[bool]  # whether its calls get contacts, in turns of `IN_TURN`
    others: bool  # whether the others get all
    calls: int = 0

    def change(self, asked: Sequence[int | None], contacts: Contacts) -> Contacts:
        query = tuple(asked[:4])
        if query == self.changed:
            self.calls += 1
            return self.queries[query] if self.parts[self.calls // IN_TURN % len(self.parts)] else ()
        return self.queries.get(query, contacts) if self.others else contacts


@judges_worlds(RULE, place=95)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    if not watched.instance.accepts_seed or watched.instance.context.budget.is_over():
        return
    for world in watched.worlds:
        queries = _list_queries(watched, world)
        often = [
            (key, one) for key, one in queries.items() if one.contacts >= OFTEN * one.calls >= OFTEN * FEWEST_CALLS
        ]
        read: set[int] = set()
        fakes = {key: tuple(_list_contacts(world, key, read)) for key in queries}
        for key, query in often[:MOST_QUERIES]:
            read.clear()
            try:
                is_ignored = _is_ignored(watched, world, key, fakes)
            except EnvironmentRaised:  # it needs a contact, or the episode that was logged raised it too
                continue
            if is_ignored:
                yield _describe(world, query, read)
                return


def _list_queries(watched: WatchedWorlds, world: LoggedWorld) -> dict[Asked, ContactQuery]:
    """Return the queries of a world, without those of the check itself, and those with the same arguments added up."""
    found: dict[Asked, ContactQuery] = {}
    for (call, client, *asked), query in watched.calls.queries.items():
        is_own = Path(call.file).is_relative_to(CHECKING)
        if world.world.engine == "PyBullet" and client == world.world.client and not is_own:
            known = found.setdefault(tuple(asked), dataclasses.replace(query, calls=0, contacts=0))
            known.calls, known.contacts = known.calls + query.calls, known.contacts + query.contacts
    return found


def _list_contacts(world: LoggedWorld, asked: Asked, read: set[int]) -> Iterator[_Contact]:
    """Yield a contact of each pair of links that a query asks for; `read` gets the fields that are read."""
    links = [(body.id, link) for body in world.world.bodies for link in range(-1, len(body.links) - 1)]
    for one, two in itertools.permutations(links, 2):
        if one[0] != two[0] and is_asked(asked, one, two):
            contact = _Contact(make_contact(one, two, distance=DISTANCE, force=FORCE, friction=FORCE))
            contact.read = read
            yield contact


def _is_ignored(watched: WatchedWorlds, world: LoggedWorld, key: Asked, fakes: Mapping[Asked, Contacts]) -> bool:
    """Say whether all that the environment returns is the same with any contacts of a query; where it joins several
    queries, the others are shown none or all."""
    if not fakes[key]:
        return False
    for others in (False, True):
        none, *changed = (
            play_in_bullet(watched, world, _Shown(fakes, key, parts, others).change)
            for parts in ((False,), (True,), (False, True))
        )
        if not all(_are_same(none, one) for one in changed):
            return False
    return True


def _are_same(one: PlayedContacts, two: PlayedContacts) -> bool:
    for rows, others in zip(one.rows, two.rows, strict=True):
        if len(rows) != len(others) or not rows:
            return False
        pairs = zip(rows, others, strict=True)
        if not all(row.shape == other.shape and np.array_equal(row, other) for row, other in pairs):
            return False
    return True


def _describe(world: LoggedWorld, query: ContactQuery, read: Collection[int]) -> RuleFinding:
    names = {body.id: body.name for body in world.world.bodies}
    bodies = [names[body] for body in query.bodies if body in names]
    of = f" of {' and '.join(bodies)}" if bodies else ""
    fields = list_names([f"{field} ({FIELDS[field]})" for field in sorted(read)], 6)
    reads = f"it reads of each the fields {fields}" if read else "it reads no field of them"
    message = f"getContactPoints returns contacts{of}, {query.contacts} in {query.calls} calls; {reads}, and nothing"
    message += " that the environment returns depends on whether there are any, or how strong they are"
    element = f"bodies {query.bodies}, links {query.links}"
    return RuleFinding(RULE, message, {"element": element}, where=(query.call.file, query.call.line))
