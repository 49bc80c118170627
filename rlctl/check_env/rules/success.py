"""RL6: success, as `info["is_success"]` tells it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rlctl.check_env.evidence import Evidence, Series
from rlctl.check_env.finding import NotApplicable, NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.rules.known import why_missing
from rlctl.check_env.rules.tried import SUCCESS, WITH_SEARCH, at, has_succeeded, in_words, reports_success, tried

INFO, WARNING = Severity.INFO, Severity.WARNING

MANY_AT_START = 0.2
"""Part of the starts that may be successes by chance: a goal that is drawn near the robot now and then."""
FEWEST_STARTS = 10
FEWEST_TRIED = 20
"""Episodes from which it is worth saying that none succeeded."""
FEWEST_STEPS = 500
"""Steps of them: less is what raises, or ends, at once."""
OTHER_NAMES = ("success", "succeeded", "goal_reached", "is_goal")


@rule(
    "RL609",
    "success is not reported",
    INFO,
    "Put info['is_success'] = bool(...) into every step's info; with rlctl.task, write is_success().",
)
def reported(evidence: Evidence) -> Iterator[Seen]:
    """info has no `is_success`. rlctl eval and Stable-Baselines3's callbacks can then tell no success rate, only
    returns, which depend on the reward's weights and say little about whether the task is done."""
    lives = tried(evidence)
    if reports_success(lives):
        return
    if not any(life.has_ended for life in lives):
        raise NotJudged("no episode ended, and it may be told at the end only")
    names = dict.fromkeys(name for life in lives for name in life.infos if name.split("/")[-1] in OTHER_NAMES)
    instead = f"; {', '.join(map(repr, names))} in info is read by nobody" if names else ""
    yield Seen(
        f"is_success is not in info: rlctl eval cannot say a success rate{instead}",
        {"value": list(names), "expected": SUCCESS},
    )


@rule(
    "RL610",
    "success at the start",
    WARNING,
    "Draw start and goal again until they are apart, and compute success from this episode's state, not from the last "
    "one's.",
    needs=("starts",),
)
def not_at_start(evidence: Evidence) -> Iterator[Seen]:
    """Many episodes are a success as they begin, with nothing done. The success rate then says little, and where
    success ends an episode most of training is wasted."""
    starts = [life for life in evidence.role("starts") if life.steps]
    if len(starts) < FEWEST_STARTS:
        raise NotJudged(why_missing(evidence, "starts"))
    if not any(SUCCESS in life.infos for life in starts):
        raise NotApplicable("is_success is not told at the first step")
    at_once = [life for life in starts if SUCCESS in life.infos and _is_true_at_once(life.infos[SUCCESS])]
    share = len(at_once) / len(starts)
    if share > MANY_AT_START:
        yield Seen(
            f"{len(at_once)} of {len(starts)} episodes are a success after one step with the zero action",
            at(at_once[0], 1, value=share, expected=f"up to {MANY_AT_START}"),
        )


def _is_true_at_once(success: Series) -> bool:
    return bool((success.values[success.steps <= 1] > 0).any())


@rule(
    "RL611",
    "success was never seen",
    INFO,
    "Check that is_success can become true: put the robot at the goal by hand, and look. If it can, the goal is only "
    "hard to find.",
    needs=WITH_SEARCH,
)
def reachable(evidence: Evidence) -> Iterator[Seen]:
    """is_success is told, but was never true in anything that was tried, a search for high returns included. A hard
    task looks the same, so this is only worth knowing; but a success that no state or reward can meet is a common
    mistake, and shows only after the training."""
    lives = tried(evidence)
    if not reports_success(lives):
        raise NotApplicable("is_success is not in info")
    if any(has_succeeded(life) for life in lives):
        return
    steps = sum(life.steps for life in lives)
    if len(lives) < FEWEST_TRIED or steps < FEWEST_STEPS or not evidence.role("search"):
        raise NotJudged(evidence.skipped.get("search", f"only {len(lives)} episodes with {steps} steps were lived"))
    best = max(lives, key=lambda life: float(np.nan_to_num(life.rewards, nan=-np.inf).max()))
    step = int(np.nan_to_num(best.rewards, nan=-np.inf).argmax())
    reward = float(best.rewards[step])
    yield Seen(
        f"is_success was not true once in {in_words(lives)}; the best reward was {reward:.4g}, at step {step + 1}",
        at(best, step + 1, value=reward, episodes=len(lives)),
    )
