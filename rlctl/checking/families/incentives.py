"""RL604, RL606 and RL609 to RL611: what the reward pays for, and success, as `info["is_success"]` reports it."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment, judges_records
from rlctl.checking.families import rewards
from rlctl.checking.instance import Context
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, CheckedEpisode, ChildMessage, Records, Skipped
from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding, Severity
from rlctl.environments.success import SUCCESS

LIKE_A_GOAL, LIKE_ANY = 0.9, 0.5  # of all rewards up to the last one: like a goal, like any; less: a failure
NEARLY = 0.05  # How much better than doing nothing something has to be, to be better
COMPARED_STEPS = 200  # How much of the episodes is compared at most: the search's are no longer
FEWEST_COMPARED, SHORTEST_COMPARED = 10, 10  # Episodes; steps of each
MOST_OF = 0.5
STARTS, FEWEST_STARTS = 30, 10
START_STEPS = 3  # More than one, to tell what belongs to the episode from chance in each step
FIRST = FIRST_SEED + 100  # The first of their seeds; none of the whole episodes has them
MANY_AT_START = 0.2  # part of the starts: a goal may be near the robot by chance
FEWEST_EPISODES = 20  # Fewer episodes say little about whether one can succeed
FEWEST_STEPS = 500  # Steps of them: less is what raises, or ends, at once
OTHER_NAMES = ("success", "succeeded", "goal_reached", "is_goal")


@judges_records("RL604", *rewards.WITH_SEARCH, of_absence=True)
def _find_paid_ends(records: Records) -> Iterator[RuleFinding]:
    episodes = rewards.require_rewarded(records)
    if not any(episode.terminated.any() for episode in episodes):
        raise NotApplicable("nothing ended an episode early")
    longest = records.require_built().max_steps or max(episode.steps for episode in episodes)
    inner = np.concatenate([episode.rewards[: episode.steps - episode.has_ended] for episode in episodes])
    ended = [episode for episode in episodes if episode.ended == "terminated" and episode.steps < longest]
    early = [episode for episode in ended if not rewards.ends_in_success(episode)]
    if not early or not inner.size or inner.max() > 0 or inner.mean() == 0:
        return
    mean = float(inner.mean())
    saved = [-rewards.DISCOUNT * rewards.discounted_steps(mean, longest - episode.steps) for episode in early]
    gains = [float(episode.rewards[-1]) - mean + much for episode, much in zip(early, saved, strict=True)]
    gain = float(np.median(gains))
    severity = _severity_of_end(episodes, early, inner)
    if gain <= 0 or severity is None:
        return
    usual = int(np.argsort(gains)[len(gains) // 2])
    example, last = early[usual], float(early[usual].rewards[-1])
    ends = f"{len(early)} of {len(episodes)} episodes ended early without success"
    why = f"The mean reward is {mean:.3g} and none but the last is above 0, so ending at step {example.steps} with"
    much = f"{saved[usual]:.3g} (discounted by {rewards.DISCOUNT} up to step {longest})"
    message = f"{ends}. {why} {last:.3g} saves {much}"
    yield RuleFinding("RL604", message, example.at(example.steps, value=last, mean_reward=mean, gain=gain), severity)


def _severity_of_end(
    episodes: Sequence[CheckedEpisode], early: Sequence[CheckedEpisode], inner: NDArray[np.float64]
) -> Severity | None:
    if rewards.reports_success(episodes):
        return Severity.WARNING
    as_good_as = float(np.median([np.mean(inner <= episode.rewards[-1]) for episode in early]))
    if as_good_as >= LIKE_A_GOAL:
        return None
    return Severity.INFO if as_good_as >= LIKE_ANY else Severity.WARNING


@judges_records("RL606", *rewards.WITH_SEARCH, of_absence=True)
def _find_paid_idleness(records: Records) -> Iterator[RuleFinding]:
    compared = [episode for episode in rewards.require_rewarded(records) if episode.role in ("episodes", "search")]
    idle = [episode for episode in compared if episode.actions == "zero"]
    others = [episode for episode in compared if episode.actions != "zero"]
    if not idle or len(others) < FEWEST_COMPARED:
        raise NotJudged(f"{len(idle)} episodes with zero actions and {len(others)} others were recorded")
    steps = min(COMPARED_STEPS, *(episode.steps for episode in idle))
    if any(episode.terminated.any() or rewards.has_succeeded(episode) for episode in idle) or steps < SHORTEST_COMPARED:
        return
    nothing = [rewards.discounted_sum(episode.rewards[:steps]) for episode in idle]
    whole = [episode for episode in others if episode.steps >= steps or episode.has_ended]
    something = [rewards.discounted_sum(episode.rewards[:steps]) for episode in whole]
    if not something or len({float(reward) for episode in compared for reward in episode.rewards[:steps]}) == 1:
        return  # a reward that never changes is RL602's
    mean, best = float(np.mean(nothing)), max(something)
    if mean <= 0 or min(nothing) <= 0 or best > mean + NEARLY * abs(mean):
        return
    bonus, share = _bonus(idle)
    because = f"; {100 * share:.0f} % of it is the term {bonus!r}, which never changes" if bonus else ""
    earned = f"doing nothing earns {mean:.4g} over {steps} steps (discounted by {rewards.DISCOUNT})"
    message = f"{earned}, the best of {len(something)} other episodes {best:.4g}{because}"
    evidence = idle[0].at(steps, value=mean, best=best, term=bonus, share=share)
    yield RuleFinding("RL606", message, evidence, Severity.WARNING if bonus else Severity.INFO)


def _bonus(idle: Sequence[CheckedEpisode]) -> tuple[str | None, float]:
    total = sum(float(np.nansum(np.abs(values))) for episode in idle for values in rewards.find_terms(episode).values())
    if total <= 0 or not all(rewards.has_terms(episode) for episode in idle):
        return None, 0.0
    steps = sum(episode.steps for episode in idle)
    shares = {name: value * steps / total for name, value in rewards.find_constant_terms(idle).items() if value > 0}
    largest = max(shares, key=lambda name: shares[name], default=None)
    return (largest, shares[largest]) if largest is not None and shares[largest] >= MOST_OF else (None, 0.0)


@experiment("starts", PROBE, 60, share=1.0)
def record_starts(context: Context) -> Iterator[ChildMessage]:
    """Reset with many seeds, and take the same few steps with the zero action after each."""
    for number in range(STARTS):
        if why := context.budget.why_spent():
            yield Skipped("starts", f"only {number} of {STARTS} starts were made: {why}")
            return
        episode = EpisodePlayer(context.instance, FIRST + number, "zero", number=number, max_steps=START_STEPS)
        yield from Recording("starts", episode).run()


@judges_records("RL609", *rewards.WITH_SEARCH, of_absence=True)
def _find_unreported_success(records: Records) -> Iterator[RuleFinding]:
    episodes = rewards.require_readable(records)
    if rewards.reports_success(episodes):
        return
    if not any(episode.has_ended for episode in episodes):
        raise NotJudged("no episode ended, and success may be reported at the end only")
    names = dict.fromkeys(name for episode in episodes for name in episode.infos if name.split("/")[-1] in OTHER_NAMES)
    instead = f"; {', '.join(map(repr, names))} in info is not used by any tool" if names else ""
    message = f"is_success is not in info: rlctl eval cannot report a success rate{instead}"
    yield RuleFinding("RL609", message, {"value": list(names), "expected": SUCCESS})


@judges_records("RL610", "starts")
def _find_success_at_start(records: Records) -> Iterator[RuleFinding]:
    starts = [episode for episode in records.role("starts") if episode.steps]
    if len(starts) < FEWEST_STARTS:
        raise NotJudged("no step could be taken" if records.role("starts") else records.why_missing("starts"))
    reported = [(start, start.infos[SUCCESS]) for start in starts if SUCCESS in start.infos]
    if not reported:
        raise NotApplicable("is_success is not reported at the first step")
    at_once = [episode for episode, success in reported if (success.values[success.steps <= 1] > 0).any()]
    share = len(at_once) / len(starts)
    if share > MANY_AT_START:
        message = f"{len(at_once)} of {len(starts)} episodes are a success after one step with the zero action"
        yield RuleFinding("RL610", message, at_once[0].at(1, value=share, expected=f"up to {MANY_AT_START}"))


@judges_records("RL611", *rewards.WITH_SEARCH, of_absence=True)
def _find_no_success(records: Records) -> Iterator[RuleFinding]:
    episodes = rewards.require_readable(records)
    if not rewards.reports_success(episodes):
        raise NotApplicable("is_success is not in info")
    if any(rewards.has_succeeded(episode) for episode in episodes):
        return
    steps = sum(episode.steps for episode in episodes)
    if len(episodes) < FEWEST_EPISODES or steps < FEWEST_STEPS or not records.role("search"):
        reason = f"only {len(episodes)} episodes with {steps} steps were recorded"
        raise NotJudged(records.skipped.get("search", reason))
    best = max(episodes, key=lambda episode: float(np.nan_to_num(episode.rewards, nan=-np.inf).max()))
    step = int(np.nan_to_num(best.rewards, nan=-np.inf).argmax())
    reward = float(best.rewards[step])
    message = f"is_success was never true in {rewards.summarize(episodes)}; best reward {reward:.4g} at step {step + 1}"
    yield RuleFinding("RL611", message, best.at(step + 1, value=reward, episodes=len(episodes)))
