"""RL812: contact query is always empty."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.experiments.worlds import MujocoTrials, WatchedWorlds, judges_trials, judges_worlds
from rlctl.checking.instance import EnvironmentRaised, Instance
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.mujoco_trials import Look, name_columns, pair_rows, play
from rlctl.checking.mujoco_worlds import FREE, MujocoStateReader
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.world_logs import LoggedWorld, WorldLog
from rlctl.checking.worlds import Array
from rlctl.environments.bullet_calls import BulletCalls, ContactQuery
from rlctl.environments.bullet_clients import ClientCalls

RULE = Rule(
    "RL812",
    "contact query is always empty",
    Severity.WARNING,
    meaning="""
        The environment waits for contacts of a part that touches nothing, while its neighbours do: the wrong
        link, geom or body is named. A reward, an end or an observation that depends on it never changes.
        PyBullet - getContactPoints never returned a contact although the bodies touched (an info if the link
        may just touch rarely). MuJoCo - a part that is looked up by its name was replaced by its neighbour, and
        flags in the observation, or the reward, began to change.
    """,
    fix="""
        Look the part up by its name, and check that it is the one that touches. In PyBullet the base is link
        -1, and a link without collision shape has no contacts.
    """,
)

CONTACT_STEPS = 60
NEVER, OFTEN = 0.02, 0.1  # Parts of all looks in which something touches
MOST_COUNTS = 9  # So many different values has a number of contacts
FEWEST_QUERIES = 50
MOSTLY = 0.3  # Part of all looks in which bodies have to touch, so that a query should have seen it


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for world in watched.worlds:
        if world.world.engine == "PyBullet":
            yield from _find_empty_queries(world, watched.calls)


@judges_trials(RULE, place=30)
def _find_untouched_parts(trials: MujocoTrials) -> Iterator[RuleFinding]:
    """Yield parts that the environment looks up by name and that touch nothing, while their neighbours do, if flags in
    the observation, or a part of the reward, wait for these contacts."""
    instance, calls, reader = trials.instance, trials.calls, trials.reader
    plain: list[Look] = []
    for kind in ("geom", "body"):
        if swapped := _find_neighbours(calls, reader, kind):
            plain = plain or play(instance, calls, CONTACT_STEPS)
            columns, size = _play_swapped(instance, calls, kind, swapped, plain)
            if columns == [size] and any((kind, other) in calls.asked for other, _ in swapped.values()):
                columns = []  # the reward may count the neighbour's contacts, too
            if columns:
                yield _untouched(kind, swapped, name_columns(columns, plain[0]), name_columns(columns[:1], plain[0]))
                return


def _play_swapped(
    instance: Instance, calls: MujocoCalls, kind: str, swapped: dict[str, tuple[str, float]], plain: Sequence[Look]
) -> tuple[list[int], int]:
    """Return the flags that begin to change where parts are their neighbours, and the observation's size."""
    calls.other_names = {(kind, name): other for name, (other, _) in swapped.items()}
    try:
        with instance.context.fresh() as another:
            changed = play(another, calls, CONTACT_STEPS)
    except EnvironmentRaised:  # it needs something of the part that its neighbour does not have
        return [], 0
    finally:
        calls.other_names = {}
    pair = pair_rows(plain, changed)
    return ([], 0) if pair is None else (_find_flags(*pair), pair[0].shape[1] - 1)


def _untouched(kind: str, swapped: dict[str, tuple[str, float]], elements: str, first: str) -> RuleFinding:
    name, (other, part) = next(iter(swapped.items()))
    waits = f"{elements} {'are' if ',' in elements else 'is'} about contacts of {kind} {list_names(list(swapped), 4)}"
    touches = f"{name} touches nothing, but its neighbour {other} does in {100 * part:.0f} % of all steps"
    return RuleFinding(RULE, f"{waits}: {touches}", {"element": first, "value": name, "expected": other})


def _find_flags(plain: Array, changed: Array) -> list[int]:
    """Return columns that are 0 and become 0 or 1, and the reward if it becomes larger by few values: what costs is
    meant not to touch. A column that becomes what another one is already is left out: the environment observes the
    neighbour, too."""
    flags = [
        column
        for column in range(plain.shape[1] - 1)
        if not plain[:, column].any()
        and set(np.unique(changed[:, column])) == {0.0, 1.0}
        and not (plain == changed[:, [column]]).all(axis=0).any()
    ]
    differences = np.unique(np.round(changed[:, -1] - plain[:, -1], 6))
    others = [c for c in range(plain.shape[1] - 1) if c not in flags and not np.array_equal(plain[:, c], changed[:, c])]
    is_counted = not others and 1 < len(differences) <= MOST_COUNTS and differences.min() == 0.0
    return [*flags, *([plain.shape[1] - 1] if is_counted else [])]


def _find_neighbours(calls: MujocoCalls, reader: MujocoStateReader, kind: str) -> dict[str, tuple[str, float]]:
    """Return, for each geom or body that was looked up and hardly ever touches anything, the neighbour that does most
    often, and in which part of all looks; empty where that is not often."""
    model, looks = reader.model, reader.touched
    rates = np.zeros(model.ngeom)
    for touched in looks:
        rates[list(touched)] += 1.0 / len(looks)
    bodies, swapped = model.geom_bodyid, {}
    for name in [name for asked, name in calls.asked if asked == kind]:
        if not (part := _find_part(model, kind, name)):
            continue
        body = int(bodies[part]) if kind == "geom" else part
        if _is_trunk(model, body):
            continue  # that it touches is a fall, whatever its legs do
        near = _find_near(model, body)
        if kind == "geom":
            rate_of = {geom: float(rates[geom]) for geom in np.flatnonzero(np.isin(bodies, near)).tolist()}
        else:
            rate_of = {body: float(rates[bodies == body].max(initial=0.0)) for body in near}
        own = rate_of.pop(part, 1.0)  # a geom of the world itself is among none of them
        names = {getattr(model, kind)(other).name: rate for other, rate in rate_of.items()}
        best = max((other for other in names if other), key=lambda other: names[other], default="")
        if own <= NEVER and best and names[best] >= OFTEN:
            swapped[name] = best, names[best]
    return swapped


def _is_trunk(model: Any, body: int) -> bool:
    """Say whether a body is the free base of others."""
    joint = int(model.body_jntadr[body])
    is_free = joint >= 0 and int(model.jnt_type[joint]) == FREE
    return is_free and bool((model.body_parentid == body).any())


def _find_near(model: Any, body: int) -> list[int]:
    """Return a body, its parent, its siblings and what is beyond it; not the world."""
    parents = model.body_parentid
    near = {body, int(parents[body])} | set(np.flatnonzero(parents == parents[body]).tolist())
    beyond = {body}
    for other in range(body + 1, model.nbody):  # children come after their parents
        if int(parents[other]) in beyond:
            beyond.add(other)
    return sorted((near | beyond) - {0})


def _find_part(model: Any, kind: str, name: str) -> int:
    try:
        return int(getattr(model, kind)(name).id)
    except KeyError:
        return 0


def _find_empty_queries(world: LoggedWorld, calls: BulletCalls) -> Iterator[RuleFinding]:
    key = lambda query: (query.call, query.client)  # noqa: E731
    for (call, client), group in itertools.groupby(sorted(calls.queries.values(), key=key), key):
        queries = list(group)
        total = sum(query.calls for query in queries)
        if client != world.world.client or total < FEWEST_QUERIES or any(query.contacts for query in queries):
            continue
        for query in queries:
            if why := _explain_empty(world, query) or _explain_alone(world, query, calls):
                text, severity = why
                message = f"{total} calls of getContactPoints returned no contact: {text}"
                evidence = {"element": f"bodies {query.bodies}, links {query.links}", "value": 0}
                yield RuleFinding(RULE, message, evidence, severity, where=(call.file, call.line))
                return


def _explain_empty(world: LoggedWorld, query: ContactQuery) -> tuple[str, Severity] | None:
    p, known = ClientCalls(query.client), {body.id for body in world.world.bodies}
    existing = {-1, *(p.getBodyUniqueId(i) for i in range(p.getNumBodies()))}
    for body, link in zip(query.bodies, query.links, strict=True):
        if body not in existing:
            return f"there is no body {body}", Severity.WARNING
        if link is not None and body >= 0 and link >= p.getNumJoints(body):
            return f"{world.world.link_name((body, -1))} has no link {link}", Severity.WARNING
        if body in known and link is not None and not _has_shape(world, body, link):
            name = world.world.link_name((body, link))
            return f"{name} (link {link}) has no collision shape", Severity.WARNING
    looks = [links for log in world.logs for links in _find_touching(log, query)]
    others = {link for links in looks for link in links}
    if not looks or sum(bool(links) for links in looks) < MOSTLY * len(looks) or query.links == (None, None):
        return None
    asked = next((body, link) for body, link in zip(query.bodies, query.links, strict=True) if link is not None)
    other = sorted(others)[0]
    text = f"{world.world.link_name(asked)} (link {asked[1]}) never touched, but {world.world.link_name(other)} did"
    is_next = any(_are_joined(query.client, asked, link) for link in others)
    return f"{text} (link {other[1]})", Severity.WARNING if is_next else Severity.INFO


def _explain_alone(world: LoggedWorld, query: ContactQuery, calls: BulletCalls) -> tuple[str, Severity] | None:
    """Explain an empty query of one of several links that are alike, of which no other is ever asked."""
    side = 0 if query.links[0] is not None else 1
    (body, link), other = (query.bodies[side], query.links[side]), query.bodies[1 - side]
    if link is None or link < 0 or query.links[1 - side] is not None:
        return None
    asked = {
        (asked.bodies[end], asked.links[end])
        for asked in calls.queries.values()
        for end in (0, 1)
        if asked.client == query.client and asked.bodies[1 - end] in (other, -1) and asked.call.file == query.call.file
    }
    twins = _find_twins(query.client, body, link)
    if not twins or asked & {(body, twin) for twin in (*twins, None, -1)}:
        return None
    names = list_names([f"{world.world.link_name((body, twin))} (link {twin})" for twin in twins])
    text = f"it asks for {world.world.link_name((body, link))} (link {link}) alone, and nothing asks for {names}"
    return f"{text}, which are like it: same parent, mass and inertia", Severity.WARNING


def _find_twins(client: int, body: int, link: int) -> list[int]:
    """Return the other links with the same parent, mass and inertia."""
    p = ClientCalls(client)

    def describe(number: int) -> tuple[object, ...]:
        mass, _, inertia, *_ = p.getDynamicsInfo(body, number)
        return p.getJointInfo(body, number)[16], mass, inertia

    others = [number for number in range(p.getNumJoints(body)) if number != link]
    weighs = p.getDynamicsInfo(body, link)[0] > 0
    return [number for number in others if weighs and describe(number) == describe(link)]


def _has_shape(world: LoggedWorld, body: int, link: int) -> bool:
    p, others = ClientCalls(world.world.client), [other.id for other in world.world.bodies if other.id != body]
    return not others or any(p.getClosestPoints(other, body, 1e3, linkIndexB=link) for other in others)


def _find_touching(log: WorldLog, query: ContactQuery) -> list[set[tuple[int, int]]]:
    """Return, for each look, the links of the asked body that touch the other one, or anything where none is named."""
    asked = 0 if query.links[0] is not None else 1
    one, other = query.bodies[asked], query.bodies[1 - asked]
    looks = []
    for pairs in log.touching:
        both = [*pairs, *((b, a) for a, b in pairs)]
        looks.append({a for a, b in both if a[0] == one and a[0] != b[0] and other in (-1, b[0])})
    return looks


def _are_joined(client: int, one: tuple[int, int], two: tuple[int, int]) -> bool:
    p = ClientCalls(client)
    pairs = (one, two), (two, one)
    return any(link >= 0 and p.getJointInfo(body, link)[16] == parent for (body, link), (_, parent) in pairs)
