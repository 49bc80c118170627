"""RL310: an ended episode leaks."""

from collections.abc import Iterator, Sequence
from typing import Any

from rlctl.checking.differences import COMPARED_STEPS, LATE, compare, find_difference, report
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.search import ActionSearch, judges_searches
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Records
from rlctl.checking.rewards import has_succeeded
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity

RULE = Rule(
    "RL310",
    "an ended episode leaks",
    Severity.ERROR,
    meaning="""
        After an episode that succeeded, terminated or ran out of time, the same seed and actions give another
        episode, with another reward, success or end. reset leaves something of the ended episode: a success
        flag, a counter, a goal. A warning if only later steps differ a little, and not after an unfinished
        episode (RL303).
    """,
    fix="Reset every attribute that step changes when an episode succeeds or ends.",
    shows_one=True,
)

MOST_SECOND_STEPS = 1_000  # most time limits are shorter
FAINT = 0.01  # smaller late differences are a residue, no counter or flag


@judges_searches(RULE, place=1, decides=False)
def _play_after_ends(search: ActionSearch) -> Iterator[ChildMessage]:
    """Record one episode on a new instance: alone, repeated, and after episodes that ended in every way there is."""
    context = search.context
    success = next((attempt.sequence[: attempt.played.steps] for attempt in search.succeeded), None)
    ended: set[str] = set()
    instance = context.build()  # not closed: closing may break the kept instance (RL402), which later experiments use

    def record(role: str, seed: int, most: int, sequence: Sequence[Any] | None = None) -> Recording:
        recording = Recording(role, EpisodePlayer(instance, seed, max_steps=most, sequence=sequence))
        recording.run()
        return recording

    def repeat(role: str) -> Iterator[ChildMessage]:
        yield from record(role, FIRST_SEED, COMPARED_STEPS).run()

    yield from repeat("before ends")
    yield from repeat("before ends again")
    if success is not None and has_succeeded(record("", FIRST_SEED, len(success), success).trajectory):
        yield from repeat("after success")
    for seed in (SECOND_SEED, SECOND_SEED + 1):
        how = record("", seed, MOST_SECOND_STEPS).trajectory.ended
        role = {"terminated": "after termination", "truncated": "after truncation"}.get(how)
        if role and role not in ended and not context.budget.why_spent():
            ended.add(role)
            yield from repeat(role)


@judges_records(RULE, "search")
def _compare_after_ends(records: Records) -> Iterator[RuleFinding]:
    first, again = records.require_role("before ends"), records.require_role("before ends again")
    if not records.require_built().accepts_seed or find_difference(records, first, again) is not None:
        raise NotJudged("an episode already depends on the previous one (RL301 to RL303)")
    for role in ("after success", "after termination", "after truncation"):
        for episode in records.role(role):
            difference = find_difference(records, again, episode)
            if difference is not None and "raised" not in (again.ended, episode.ended):
                is_mild = difference.step > LATE and difference.size < FAINT
                if (is_mild or difference.is_small) and _is_left_by_others(records):
                    continue
                ending = "that succeeded" if role == "after success" else f"that ended in {role[6:]}"
                what = f"played again after an episode {ending}"
                yield report(RULE, records, difference, what, mild=is_mild)
                return


def _is_left_by_others(records: Records) -> bool:
    """Say whether an unfinished episode leaves something, too (RL303): a residue then has nothing to do with an end."""
    return bool(records.role("dirty")) and compare(records, "alone", "dirty") is not None
