"""RL502: terminated and truncated at once."""

from collections.abc import Iterator

from rlctl.checking.episode_ends import require_episodes
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL502",
    "terminated and truncated at once",
    Severity.ERROR,
    meaning="""
        Episodes that run out of time also set `terminated`. Algorithms then ignore `truncated` and treat the
        time limit as a failure. A single coincidence of both is fine.
    """,
    fix="""
        truncated = not terminated and self.steps >= limit; terminated only for what the state itself decides.
    """,
)


@judges_records(RULE, "episodes", of_absence=True)
def _find_both_flags(records: Records) -> Iterator[RuleFinding]:
    episodes = require_episodes(records)
    both = [episode for episode in episodes if episode.ended == "both"]
    if len(both) >= 2 and not any(episode.ended == "truncated" for episode in episodes):
        message = f"{len(both)} episodes end with terminated=True and truncated=True, none with truncated alone"
        yield RuleFinding(RULE, message, both[0].at(both[0].steps, value=len(both), expected=0))
