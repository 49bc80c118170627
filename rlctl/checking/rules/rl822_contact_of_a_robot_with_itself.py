"""RL822: contact of a robot with itself."""

from collections.abc import Iterator

from rlctl.checking.action_trials import REWARD, Frame, Trials, find_differences
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.instance import EnvironmentRaised, Instance
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.environments.bullet_calls import BulletCalls, ContactQuery

RULE = Rule(
    "RL822",
    "contact of a robot with itself",
    Severity.INFO,
    meaning="""
        getContactPoints asks for the contacts of a link with anything, and sometimes a link of the same robot is all
        that it touches. Reward, observation or end count that like a contact with the floor or an object.
    """,
    fix="Give bodyB, the body that the link should touch, or leave out contacts whose two bodies are the same.",
    shows_one=True,
)

MOSTLY = 0.3  # Part of the calls in which a link touches another body: a foot does, a part that must not collide not
SEEDS = (FIRST_SEED + 1, FIRST_SEED + 2, FIRST_SEED + 4)  # Logged episodes with random actions
STEPS = 60


@judges_worlds(RULE, place=90)
def _find_own_contacts(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    """Yield a query that returned only contacts of a robot with itself, if the environment changes without these."""
    calls, context = watched.calls, watched.instance.context
    queries = [query for query in calls.queries.values() if _is_of_one_link(query) and query.own]
    queries = [query for query in queries if query.others >= MOSTLY * query.calls]
    if not queries or calls.without_client or not watched.instance.accepts_seed or context.budget.is_over():
        return
    query = max(queries, key=lambda query: query.own)
    numbers = f"in {query.own} of {query.calls} calls"
    place, met = (query.call.file, query.call.line), query.met
    worlds = [world for world in watched.worlds if world.world.client == query.client]
    body = max(query.bodies)
    try:
        changed = _find_changed(watched.instance, calls)
    except (EnvironmentRaised, NotJudged):  # an episode that was logged raised it too, or time ran out
        return
    if not changed or not worlds:
        return
    one, two = (worlds[0].world.link_name((body, link)) for link in met)
    what = f"getContactPoints without bodyB {numbers} returned only contacts of {one} with {two}"
    yield RuleFinding(RULE, f"{what}, and {changed} counts them", {"element": one, "value": two}, where=place)


def _is_of_one_link(query: ContactQuery) -> bool:
    """Say whether a query is about one link of a body, and whatever it touches."""
    asked = [link for link in query.links if link is not None]
    return sorted(body >= 0 for body in query.bodies) == [False, True] and len(asked) == 1


def _find_changed(instance: Instance, calls: BulletCalls) -> str:
    """Return what changes first where contacts of bodies with themselves are left out; empty for nothing."""
    plain, again = _play_all(instance), _play_all(instance)
    calls.hides_own = True
    try:
        without = _play_all(instance)
    finally:
        calls.hides_own = False
    for one, same, other in zip(plain, again, without, strict=True):
        differences = find_differences(one, other)
        step = min(differences, default=0)
        if differences and step not in find_differences(one, same):
            return _name_column(int(differences[step][0]), len(one[step]))
    return ""


def _play_all(instance: Instance) -> list[list[Frame]]:
    """Play episodes in an instance of their own: some do not repeat to the last bit after others."""
    with instance.context.fresh() as another:
        trials = Trials(another)
        return [trials.play(seed, trials.actions(seed, STEPS)) for seed in SEEDS]


def _name_column(column: int, size: int) -> str:
    if column == REWARD:
        return "the reward"
    if column > REWARD:
        return "the end of the episode"
    return f"observation[{size + column}]"
