"""RL609 to RL611: success, as `info["is_success"]` reports it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rlctl.check_env.context import Context
from rlctl.check_env.episode import Episode
from rlctl.check_env.experiment import check, experiment
from rlctl.check_env.finding import Finding, NotApplicable, NotJudged
from rlctl.check_env.messages import FIRST_SEED, Message, Skipped
from rlctl.check_env.recording import Recording
from rlctl.check_env.records import Records
from rlctl.check_env.rewarded import (
    SUCCESS,
    WITH_SEARCH,
    at_step,
    has_succeeded,
    reports_success,
    require_readable,
    summarize,
)

STARTS = 30
START_STEPS = 3
"""More than one, to tell what belongs to the episode from chance in each step."""
FIRST = FIRST_SEED + 100
"""The first of their seeds; none of the whole episodes has them."""
MAX_FAILURES = 3
MANY_AT_START = 0.2
"""Part of the starts that may be successes by chance: a goal that is drawn near the robot now and then."""
FEWEST_STARTS = 10
FEWEST_EPISODES = 20
"""Fewer episodes say little about whether one can succeed."""
FEWEST_STEPS = 500
"""Steps of them: less is what raises, or ends, at once."""
OTHER_NAMES = ("success", "succeeded", "goal_reached", "is_goal")


@experiment("starts", share=1.0)
def record_starts(context: Context) -> Iterator[Message]:
    """Reset with many seeds, and take the same few steps with the zero action after each."""
    failures = 0
    for number in range(STARTS):
        if context.budget.seconds_left < 0 or context.budget.bytes_left < 0 or failures >= MAX_FAILURES:
            yield Skipped("starts", f"only {number} of {STARTS} starts could be made")
            return
        episode = Episode(context.instance, FIRST + number, "zero", number=number, max_steps=START_STEPS)
        recording = Recording("starts", episode, context.budget)
        yield from recording.run()
        failures += recording.failure is not None


@check("RL609", *WITH_SEARCH)
def find_unreported_success(records: Records) -> Iterator[Finding]:
    episodes = require_readable(records)
    if reports_success(episodes):
        return
    if not any(each.has_ended for each in episodes):
        raise NotJudged("no episode ended, and success may be reported at the end only")
    names = dict.fromkeys(name for each in episodes for name in each.infos if name.split("/")[-1] in OTHER_NAMES)
    instead = f"; {', '.join(map(repr, names))} in info is read by nobody" if names else ""
    message = f"is_success is not in info: rlctl eval cannot report a success rate{instead}"
    yield Finding("RL609", message, {"value": list(names), "expected": SUCCESS})


@check("RL610", "starts")
def find_success_at_start(records: Records) -> Iterator[Finding]:
    starts = [each for each in records.role("starts") if each.steps]
    if len(starts) < FEWEST_STARTS:
        raise NotJudged(records.why_missing("starts"))
    reported = [(each, each.infos[SUCCESS]) for each in starts if SUCCESS in each.infos]
    if not reported:
        raise NotApplicable("is_success is not reported at the first step")
    at_once = [each for each, success in reported if (success.values[success.steps <= 1] > 0).any()]
    share = len(at_once) / len(starts)
    if share > MANY_AT_START:
        message = f"{len(at_once)} of {len(starts)} episodes are a success after one step with the zero action"
        yield Finding("RL610", message, at_step(at_once[0], 1, value=share, expected=f"up to {MANY_AT_START}"))


@check("RL611", *WITH_SEARCH)
def find_no_success(records: Records) -> Iterator[Finding]:
    episodes = require_readable(records)
    if not reports_success(episodes):
        raise NotApplicable("is_success is not in info")
    if any(has_succeeded(each) for each in episodes):
        return
    steps = sum(each.steps for each in episodes)
    if len(episodes) < FEWEST_EPISODES or steps < FEWEST_STEPS or not records.role("search"):
        reason = f"only {len(episodes)} episodes with {steps} steps were recorded"
        raise NotJudged(records.skipped.get("search", reason))
    best = max(episodes, key=lambda each: float(np.nan_to_num(each.rewards, nan=-np.inf).max()))
    step = int(np.nan_to_num(best.rewards, nan=-np.inf).argmax())
    reward = float(best.rewards[step])
    yield Finding(
        "RL611",
        f"is_success was not true once in {summarize(episodes)}; the best reward was {reward:.4g}, at step {step + 1}",
        at_step(best, step + 1, value=reward, episodes=len(episodes)),
    )
