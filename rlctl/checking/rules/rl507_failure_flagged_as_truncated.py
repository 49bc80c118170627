"""RL507: failure flagged as truncated."""

from collections.abc import Iterator

from rlctl.checking.episode_ends import require_episodes
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL507",
    "failure flagged as truncated",
    Severity.WARNING,
    meaning="""
        Episodes end with `truncated` at many different steps, and never with `terminated`. Learning then values
        the state after a failure as if the episode continued there, and does not learn to avoid it. Leaving an
        area without failure is truncated as well, so this is a warning.
    """,
    fix="Return terminated=True for a failure or a success, and truncated=True only when time is up.",
)

FEWEST_LENGTHS = 2  # With fewer different lengths it may be one that is unlike the others


@judges_records(RULE, "episodes", of_absence=True)
def _find_failure_as_truncated(records: Records) -> Iterator[RuleFinding]:
    episodes = require_episodes(records)
    lengths = [episode.steps for episode in episodes if episode.ended == "truncated"]
    limit = records.require_built().max_steps or max(lengths, default=0)
    early = [steps for steps in lengths if steps < limit]
    steps = sorted(set(early))
    if any(episode.terminated.any() for episode in episodes) or len(steps) < FEWEST_LENGTHS:
        return
    message = f"{len(early)} of {len(episodes)} episodes are truncated before step {limit}, at {len(steps)} different "
    yield RuleFinding(RULE, f"{message}steps, and none is terminated", {"value": steps, "expected": limit})
