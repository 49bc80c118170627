"""RL5: how episodes end."""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.evidence import ENDS, Evidence, Trajectory
from rlctl.check_env.finding import NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import Attributes
from rlctl.check_env.rules.known import built, result
from rlctl.check_env.studies import LIVES

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

FEWEST_EPISODES = 6
SHORTEST_LIMIT = 5
"""Games of fewer steps that always end together are games, not time limits [steps]."""
FEWEST_TIES = 4
SHORTEST_TIE = 20
"""The same, where only some episodes end together [steps]."""
ENOUGH_STEPS = 1_000
"""An episode that was cut earlier says nothing about whether it would end [steps]."""


def _episodes(evidence: Evidence) -> list[Trajectory]:
    """The probe's episodes that can be judged: those that did not raise."""
    built(evidence)
    episodes = [each for each in evidence.episodes if each.ended != "raised"]
    if not episodes:
        raise NotJudged(evidence.skipped.get("episodes", "no episode could be lived"))
    return episodes


@rule(
    "RL501",
    "time limit flagged as terminated",
    ERROR,
    "Return terminated=False, truncated=True when time is up, or leave time to gymnasium.wrappers.TimeLimit.",
)
def time_limit(evidence: Evidence) -> Iterator[Seen]:
    """Episodes end with `terminated` after exactly the same number of steps. The learner then takes running out of
    time for a state without a future: values near the end are wrong, and it learns to hurry or to give up."""
    episodes = _episodes(evidence)
    if any(form.what == "step" for each in episodes for form in each.forms):
        raise NotJudged("step returns one flag for both (RL201)")
    if any(each.ended in ("truncated", "both") for each in episodes):
        return
    ended = [each for each in episodes if each.ended == "terminated"]
    lengths = [each.steps for each in ended]
    if any(each.steps > max(lengths, default=0) for each in episodes if each.ended not in ENDS):
        return  # some episode went on for longer
    if len(ended) < FEWEST_EPISODES or len({each.actions for each in ended}) < 2:
        raise NotJudged(f"only {len(ended)} episodes ended")
    limit = max(lengths)
    ties = [each for each in ended if each.steps == limit]
    evidence_ = {
        "step": limit,
        "episodes": len(ties),
        "of": len(episodes),
        "value": "terminated",
        "expected": "truncated",
    }
    if limit < SHORTEST_LIMIT:
        return
    if len(ties) == len(episodes):
        yield Seen(
            f"all {len(ties)} episodes, whatever the actions, end at step {limit} with terminated=True",
            evidence_,
        )
    elif limit >= SHORTEST_TIE and len(ties) >= FEWEST_TIES and len({each.actions for each in ties}) > 1:
        yield Seen(
            f"{len(ties)} of {len(episodes)} episodes end at step {limit} with terminated=True, and none lasts longer",
            evidence_,
            WARNING,
        )


@rule(
    "RL502",
    "terminated and truncated at once",
    ERROR,
    "truncated = not terminated and self.steps >= limit; terminated only for what the state itself decides.",
)
def both_flags(evidence: Evidence) -> Iterator[Seen]:
    """Episodes that run out of time say `terminated` as well. Learners then ignore `truncated`, and treat the time
    limit as a failure. A single coincidence of both is fine."""
    episodes = _episodes(evidence)
    both = [each for each in episodes if each.ended == "both"]
    clean = [each for each in episodes if each.ended == "truncated"]
    if len(both) >= 2 and not clean:
        first = both[0]
        message = f"{len(both)} episodes end with terminated=True and truncated=True, none with truncated alone"
        yield Seen(message, {**first.place, "step": first.steps, "value": len(both), "expected": 0})


@rule(
    "RL503",
    "episodes never end",
    WARNING,
    "Wrap it in gymnasium.wrappers.TimeLimit, register it with max_episode_steps, or count steps and truncate.",
)
def ends(evidence: Evidence) -> Iterator[Seen]:
    """Episodes go on without end, and no time limit is known. Most of a training may then pass in one useless
    state, returns are never complete, and evaluation does not come back."""
    known, episodes = built(evidence), _episodes(evidence)
    if any(each.ended == "truncated" for each in episodes):
        return
    longest: dict[str, Trajectory] = {}
    for each in episodes:
        if not each.has_ended and each.steps > (longest[each.actions].steps if each.actions in longest else 0):
            longest[each.actions] = each
    if not longest:
        return
    limit = known.max_steps
    steps = {kind: each.steps for kind, each in longest.items()}
    if max(steps.values()) < (limit or ENOUGH_STEPS):
        raise NotJudged(f"no end within {max(steps.values())} steps, and there was no time for more")
    declared = f", past its own limit of {limit}" if limit else " and no time limit is known"
    lived = ", ".join(f"{count:,} with {kind} actions" for kind, count in steps.items())
    yield Seen(f"no end within {lived}{declared}", {"steps": steps, "expected": limit})


@rule(
    "RL504",
    "episodes end at once",
    WARNING,
    "Check the condition of terminated right after reset, and that reset clears it.",
    complaints=(r"truncates after 1 step",),
)
def ends_at_once(evidence: Evidence) -> Iterator[Seen]:
    """Every episode ends on its first step, whatever the action. A bandit does, a robot does not."""
    episodes = _episodes(evidence)
    if len(episodes) >= FEWEST_EPISODES and all(each.has_ended and each.steps == 1 for each in episodes):
        yield Seen(f"all {len(episodes)} episodes end on step 1", {"step": 1, "episodes": len(episodes)})


@rule(
    "RL506",
    "no time limit",
    WARNING,
    "Wrap it in gymnasium.wrappers.TimeLimit, register it with max_episode_steps, or count steps and truncate.",
    needs=(*LIVES, "attributes"),
)
def limited(evidence: Evidence) -> Iterator[Seen]:
    """Every episode so far ended by failing (or succeeding), and there is no time limit. The episode of a good policy
    that neither falls nor arrives then never ends: training and evaluation stop in it."""
    known, episodes = built(evidence), _episodes(evidence)
    if known.max_steps is not None or any(each.ended != "terminated" for each in episodes):
        return  # RL503 tells of those that did not end
    lengths = [each.steps for each in episodes]
    is_continuous = any(leaf.kind == "Box" for leaf in known.leaves)
    if len(set(lengths)) == 1 or (max(lengths) < SHORTEST_TIE and not is_continuous):
        return  # a bandit, or a game of a few moves
    if any(form.what == "step" for each in episodes for form in each.forms):
        raise NotJudged("step returns one flag for both (RL201)")
    if list(time_limit.run(evidence)):
        raise NotJudged("a time limit seems to be flagged as terminated (RL501)")
    truncation = result(evidence, Attributes, "attributes").truncation
    if truncation == "computed":
        return  # its limit was not reached
    why = "step always returns truncated=False" if truncation == "never" else "none is declared or was seen"
    yield Seen(
        f"no time limit: {why}; all {len(episodes)} episodes ended with terminated=True, the longest after "
        f"{max(lengths)} steps",
        {"episodes": len(episodes), "value": None, "expected": "max_episode_steps", "step": max(lengths)},
        WARNING if is_continuous and truncation == "never" else INFO,
    )
