"""RL6: what the reward makes worth doing, found by comparing what was tried."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.check_env.evidence import Evidence, Trajectory
from rlctl.check_env.families.determinism import compare as compared
from rlctl.check_env.finding import NotApplicable, NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.rules.reward_terms import constants
from rlctl.check_env.rules.tried import (
    DISCOUNT,
    TERMS,
    WITH_SEARCH,
    at,
    discounted,
    ends_in_success,
    has_succeeded,
    limit,
    reports_success,
    rewarded,
    terms,
    worth_of,
)

WARNING, INFO = Severity.WARNING, Severity.INFO

LIKE_A_GOAL, LIKE_ANY = 0.9, 0.5
"""Part of all rewards that the last one of an episode is as good as, from which its end looks like a goal, or like
nothing in particular. Below, it looks like a failure."""
LATE = 10
"""Up to how many steps before its end another episode may part from one that finished, to be compared with it."""
FAR_ABOVE = 5.0
"""The last reward of an episode is that of a goal, where none is told, if it stands out by so many times the spread of
the rewards in its first half: a robot that falls while it walks fast ends with a good reward too."""
CLEARLY = 0.1
"""How much more hovering has to be worth than finishing."""
NEARLY = 0.05
"""How much better than doing nothing something has to be, to be better."""
FEWEST_COMPARED = 10
COMPARED_STEPS = 200
"""How much of the episodes is compared at most: the search's are no longer."""
SHORTEST_COMPARED = 10
MOST_OF = 0.5


@rule(
    "RL604",
    "ending early pays",
    WARNING,
    "Give a failure a penalty that is worse than going on badly to the end, or add a bonus per step, or do not end the "
    "episode. If the end is the goal, tell it with info['is_success'].",
    needs=WITH_SEARCH,
)
def dying_pays(evidence: Evidence) -> Iterator[Seen]:
    """All rewards are negative, and an episode can be ended early by something that is no success. Then falling over
    soon costs less than trying for long, and that is learned first. A warning where is_success says that the end is
    none, or where the last reward is among the worst; no finding where the end looks like a goal."""
    lives = rewarded(evidence)
    if not any(life.terminated.any() for life in lives):
        raise NotApplicable("nothing that was tried ended an episode early")
    longest = limit(evidence, lives)
    inner = np.concatenate([life.rewards[: life.steps - life.has_ended] for life in lives])
    early = [
        each for each in lives if each.ended == "terminated" and each.steps < longest and not ends_in_success(each)
    ]
    if not early or not inner.size or inner.max() > 0 or inner.mean() == 0:
        return
    mean = float(inner.mean())
    gains = [float(life.rewards[-1]) - mean - DISCOUNT * worth_of(mean, longest - life.steps) for life in early]
    gain = float(np.median(gains))
    severity = _severity_of_end(lives, early, inner)
    if gain <= 0 or severity is None:
        return
    example = early[int(np.argmax(gains))]
    last = float(example.rewards[-1])
    yield Seen(
        f"{len(early)} of {len(lives)} episodes ended early without success. The mean reward is {mean:.3g} and none "
        f"but the last is above 0, so ending at step {example.steps} with {last:.3g} saves "
        f"{-DISCOUNT * worth_of(mean, longest - example.steps):.3g} (discounted by {DISCOUNT} up to step {longest})",
        at(example, example.steps, value=last, mean_reward=mean, gain=gain),
        severity,
    )


def _severity_of_end(
    lives: Sequence[Trajectory], early: Sequence[Trajectory], inner: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> Severity | None:
    if reports_success(lives):
        return WARNING
    as_good_as = float(np.median([np.mean(inner <= life.rewards[-1]) for life in early]))
    return None if as_good_as >= LIKE_A_GOAL else INFO if as_good_as >= LIKE_ANY else WARNING


@dataclasses.dataclass(frozen=True)
class _Pair:
    """Two lives that are the same up to a step, from where one finishes and the other does not."""

    finished: Trajectory
    hovered: Trajectory
    step: int
    worth: tuple[float, float]
    """Of finishing and of hovering, from that step on."""
    per_step: float
    """The mean reward of hovering."""


@rule(
    "RL605",
    "hovering pays more than finishing",
    WARNING,
    "Pay for finishing at least what staying near the goal would earn to the end of the episode, pay for progress "
    "instead of for being near, or do not end the episode at the goal.",
    needs=WITH_SEARCH,
)
def hovering(evidence: Evidence) -> Iterator[Seen]:
    """The goal ends the episode, and with it a positive reward per step: stopping just before the goal and staying
    there is worth more than finishing. That is what will be learned. Found by living an episode that finished once
    more, and stopping shortly before its end."""
    lives = rewarded(evidence)
    finished = [life for life in lives if _finishes(life, reports_success(lives))]
    if not finished:
        raise NotApplicable("nothing that was tried ended an episode at a goal")
    if max(float(life.rewards[:-1].max(initial=0.0)) for life in lives) <= 0:
        return  # there is nothing to be earned by staying
    if compared(evidence, "alone", "reused")[1] is not None:
        raise NotJudged("equal seeds and actions give unequal episodes (RL301, RL302)")
    others = [life for life in evidence.role("search") if life.steps and not _finishes(life, reports_success(lives))]
    longest = limit(evidence, lives)
    pairs = [pair for one in finished for two in others if (pair := _pair(one, two, longest)) is not None]
    if not pairs:
        raise NotJudged("no episode that stops just before the goal could be lived")
    best = max(pairs, key=lambda pair: pair.worth[1] - pair.worth[0])
    finishing, hovering = best.worth
    if best.per_step > 0 and hovering > finishing + CLEARLY * abs(finishing):
        yield Seen(
            f"finishing at step {best.finished.steps} is worth {finishing:.4g} from step {best.step + 1} on; stopping "
            f"there instead earns {best.per_step:.3g} per step, worth {hovering:.4g} (discounted by {DISCOUNT} up to "
            f"step {longest})",
            at(best.finished, best.step + 1, value=hovering, expected=f"below {finishing:.6g}", per_step=best.per_step),
        )


def _finishes(life: Trajectory, success_is_told: bool) -> bool:
    """Whether a life ended at the goal: by its own word, or else with a reward far above what it began with."""
    if life.ended not in ("terminated", "both"):
        return False
    if success_is_told:
        return ends_in_success(life)
    begin = life.rewards[: life.steps // 2]
    return len(begin) > 1 and bool(life.rewards[-1] > begin.max() + FAR_ABOVE * np.ptp(begin))


def _pair(one: Trajectory, two: Trajectory, longest: int) -> _Pair | None:
    if one.role != two.role or one.seed != two.seed or two.steps <= one.steps:
        return None
    differ = (one.action_values != two.action_values[: one.steps]).any(axis=1)
    step = int(differ.argmax()) if differ.any() else one.steps
    if not differ.any() or step < one.steps - LATE or two.ended == "raised":
        return None
    rest = two.rewards[step:]
    per_step = float(rest.mean())
    to_come = 0 if two.has_ended else longest - two.steps
    hovering = discounted(rest) + DISCOUNT ** len(rest) * worth_of(float(rest[-LATE:].mean()), to_come)
    return _Pair(one, two, step, (discounted(one.rewards[step:]), hovering), per_step)


@rule(
    "RL606",
    "doing nothing pays",
    INFO,
    "Make the bonus for being alive smaller than what the task itself pays, or pay it only together with progress, and "
    "see with --json what each term earns.",
    needs=WITH_SEARCH,
)
def doing_nothing(evidence: Evidence) -> Iterator[Seen]:
    """The zero action earns a positive return to the end, and nothing that was tried earns more: a policy can settle
    for standing still. Worth knowing where the task may be just that; a warning where info["reward_terms"] tells that
    most of it is a bonus which never changes."""
    lives = rewarded(evidence)
    compared = [life for life in lives if life.role in ("episodes", "search")]
    idle = [life for life in compared if life.actions == "zero"]
    others = [life for life in compared if life.actions != "zero"]
    if not idle or len(others) < FEWEST_COMPARED:
        raise NotJudged(f"{len(idle)} episodes with zero actions and {len(others)} others were lived")
    steps = min(COMPARED_STEPS, *(life.steps for life in idle))
    if any(life.terminated.any() or has_succeeded(life) for life in idle) or steps < SHORTEST_COMPARED:
        return
    nothing = [discounted(life.rewards[:steps]) for life in idle]
    something = [discounted(life.rewards[:steps]) for life in others if life.steps >= steps or life.has_ended]
    if not something or len({float(each) for life in compared for each in life.rewards[:steps]}) == 1:
        return  # a reward that never changes is RL602's
    worth, best = float(np.mean(nothing)), max(something)
    if worth <= 0 or min(nothing) <= 0 or best > worth + NEARLY * abs(worth):
        return
    bonus, share = _bonus(idle)
    because = f"; {100 * share:.0f} % of it is the term {bonus!r}, which never changes" if bonus else ""
    yield Seen(
        f"doing nothing is worth {worth:.4g} over {steps} steps (discounted by {DISCOUNT}), the best of "
        f"{len(something)} other episodes {best:.4g}{because}",
        at(idle[0], steps, value=worth, best=best, term=bonus, share=share),
        WARNING if bonus else None,
    )


def _bonus(idle: Sequence[Trajectory]) -> tuple[str | None, float]:
    """Return the constant positive term that is most of the reward, if there is one, and its share."""
    if not all(any(name.startswith(TERMS) for name in life.infos) for life in idle):
        return None, 0.0
    total = sum(float(np.nansum(np.abs(values))) for life in idle for values in terms(life).values())
    steps = sum(life.steps for life in idle)
    shares = {name: value * steps / total for name, value in constants(list(idle)).items() if value > 0 and total > 0}
    largest = max(shares, key=lambda name: shares[name], default=None)
    if largest is None or shares[largest] < MOST_OF:
        return None, 0.0
    return largest, shares[largest]
