"""RL835: two contacts of one foot."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.compared_ids import find_doubled_ids
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.feet import find_feet, read_touches
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.shared_frames import name_observed
from rlctl.checking.term_names import split_name
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL835",
    "two contacts of one foot",
    Severity.WARNING,
    meaning="""
        Two neighbouring elements of the observation say whether feet, fingers or wheels touch something. Both always
        say the same, and follow one link, while another link touches at other times, and no element follows it. Or a
        list of the source looks up one name twice, or asks for one contact twice. One of the two was looked up by the
        name or the number of the other. Rewards that use these contacts are wrong for that link as well.
    """,
    fix="Look each link or geom up by its own name; check that the list of them has no entry twice.",
)

FEWEST = 60  # looks
FOLLOWS, LESS = 0.7, 0.3  # correlation of a contact with what touches; by how much others are below it
UNSEEN = 0.5  # correlation of any element with the contact of the other link
DIFFERENT = 0.1  # part of the looks in which one link touches and the other does not
NEAR = 4  # elements, of which one may be that of another foot
AT_ENDS = 0.2  # part of its range by which a flag with noise is away from its ends


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    yield from itertools.islice(find_doubled_ids(RULE, noted.source, noted.of_steps), 1)


@judges_worlds(RULE)
def _find_repeated_contacts(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        links = find_feet(one.world)
        if len(links) < 2 or len(one.observed) < FEWEST:
            continue
        touches = np.concatenate([read_touches(log, links) for log in one.logs])
        names, parts = name_observed(watched.instance.env, one)
        active = {place: _read_active(values) for place, values in enumerate(one.observed.T) if np.ptp(values) > 0}
        pairs = list(_find_pairs(active, names, parts))
        follows = {place: _correlate(values, touches) for place, values in active.items()} if pairs else {}
        for first, second in pairs:
            if unseen := _find_unseen(follows[first], [follows[place] for place in follows], touches):
                yield _describe(one, names, (first, second), (links[unseen[0]], links[unseen[1]]), touches[:, unseen])
                return


def _read_active(values: Array) -> NDArray[np.bool_]:
    """Say when a contact is felt: a flag, perhaps with noise, is nearer its upper end; a force above its least."""
    low, width = values.min(), np.ptp(values)
    parts = (values - low) / width
    is_flag = (np.minimum(parts, 1 - parts) <= AT_ENDS).all()
    return np.asarray(parts > 0.5 if is_flag else parts > 0)


def _correlate(active: NDArray[np.bool_], touches: NDArray[np.bool_]) -> Array:
    """Return the correlations with each link that touches, now or at the look before. Shape (links,)."""
    found = np.zeros(touches.shape[1])
    for rows, others in ((active, touches), (active[1:], touches[:-1])):
        one, two = rows - rows.mean(), others - others.mean(axis=0)
        sizes = np.sqrt((one @ one) * np.square(two).sum(axis=0))
        found = np.maximum(found, np.divide(one @ two, sizes, out=np.zeros(len(sizes)), where=sizes > 0))
    return found


def _find_pairs(
    active: dict[int, NDArray[np.bool_]], names: Sequence[str], parts: Sequence[str]
) -> Iterator[tuple[int, int]]:
    """Yield elements that are near each other, or whose arrays have nearly the same name, and always say the same."""
    alike: dict[bytes, list[int]] = {}
    for place, values in active.items():
        if values.any() and not values.all():
            alike.setdefault(values.tobytes(), []).append(place)
    for first, second in (pair for places in alike.values() for pair in itertools.combinations(places, 2)):
        is_near = parts[first] == parts[second] and second - first <= NEAR
        apart = {*split_name(parts[first])} ^ {*split_name(parts[second])}
        if is_near or (parts[first] != parts[second] and len(apart) == 2):
            yield first, second


def _find_unseen(follows: Array, every: Sequence[Array], touches: NDArray[np.bool_]) -> list[int]:
    """Return the link that a contact follows and one that no element follows; empty where there are none."""
    own = int(follows.argmax())
    for other in np.argsort(follows).tolist():
        is_apart = (touches[:, own] & ~touches[:, other]).mean() + (touches[:, other] & ~touches[:, own]).mean()
        if other == own or follows[own] < FOLLOWS or follows[own] - follows[other] < LESS or is_apart < DIFFERENT:
            continue
        if max(row[other] for row in every) < UNSEEN:
            return [own, other]
    return []


def _describe(
    one: ObservedWorld,
    names: Sequence[str],
    places: tuple[int, int],
    links: tuple[tuple[int, int], tuple[int, int]],
    touches: NDArray[np.bool_],
) -> RuleFinding:
    first, second = (names[place] for place in places)
    own, other = (one.world.world.link_name(link) for link in links)
    message = f"{second} is always the same as {first}, which follows the contact of {own}; {other} touches in"
    message += f" {touches[:, 1].mean():.0%} of {len(touches)} looks, {own} in {touches[:, 0].mean():.0%}, and no"
    message += " element follows it"
    evidence = {"element": second, "elements": [first, second], "value": other, "expected": own}
    return RuleFinding(RULE, message, evidence)
