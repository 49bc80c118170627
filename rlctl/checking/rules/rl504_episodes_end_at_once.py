"""RL504: episodes end at once."""

from collections.abc import Iterator

from rlctl.checking.episode_ends import FEWEST_EPISODES, require_episodes
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL504",
    "episodes end at once",
    Severity.WARNING,
    meaning="""
        Every episode ends on its first step, or, where observations and actions are continuous, within 4 steps,
        whatever the action. That is right for a bandit, not for a robot.
    """,
    fix="""
        Check the condition of terminated right after reset, that reset clears it, and the unit of the time
        limit.
    """,
)

LONGEST_AT_ONCE = 4  # so short episodes are no robot's [steps]


@judges_records(RULE, "episodes")
def _find_end_at_once(records: Records) -> Iterator[RuleFinding]:
    episodes = require_episodes(records)
    built, longest = records.require_built(), max(episode.steps for episode in episodes)
    is_robot = all(leaf.kind == "Box" and "float" in leaf.dtype for leaf in (*built.leaves, *built.action_leaves))
    all_ended = len(episodes) >= FEWEST_EPISODES and all(episode.has_ended for episode in episodes)
    if all_ended and longest <= (LONGEST_AT_ONCE if is_robot else 1):
        message = f"all {len(episodes)} episodes end on step 1" + f" to {longest}" * (longest > 1)
        yield RuleFinding(RULE, message, {"step": longest, "episodes": len(episodes)})
