"""RL626: success of another link."""

from collections.abc import Iterator

from rlctl.checking.experiments.goals import GoalTrials, judges_goals
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL626",
    "success of another link",
    Severity.WARNING,
    meaning="""
        The observation shows the way from one link to the goal, and is_success is true where another link is at
        the goal. The check put the goal at each link to see it. Most often a link's index or name is that of its
        neighbour, or what was meant is the tip, and what is read is the body that carries it.
    """,
    fix="Use the same link, and the same point of it, in the observation, in the reward and for success.",
)

EPISODES = 3


@judges_goals(RULE)
def _find_other_link(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Put the goal at each link of a fixed robot where nothing that is observed has to be at the goal."""
    relative = [source for source in trials.drawn.copies if source in trials.drawn.reaches]
    if not relative:
        yield Skipped(RULE.id, "no link of a fixed robot is observed relative to the goal", applies=False)
        return
    at_goal = trials.at_goal
    if not at_goal.reports_success or at_goal.source is not None:
        return
    for name in _find_links(trials):
        observed = f"observation[{relative[0][0]}]"
        message = f"is_success is true with {trials.drawn.name} at {name}, and not where {observed} is 0"
        yield RuleFinding(RULE, message, {"element": observed, "seed": FIRST_SEED, "value": name})
        return


def _find_links(trials: GoalTrials) -> list[str]:
    """Return the names of the links at which a goal is a success in every episode."""
    common: dict[str, int] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        places = trials.find_links(seed)
        for name, place in places.items():
            common[name] = common.get(name, 0) + bool(trials.succeeds(seed, place))
    return [name for name, count in common.items() if count == EPISODES]
