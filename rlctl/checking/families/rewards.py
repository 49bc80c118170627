"""RL6: the reward as a number, its terms in `info["reward_terms"]`, and for other goals (RL601-603, 612, 614)."""

import re
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment, judges_records
from rlctl.checking.instance import Context, EnvironmentRaised
from rlctl.checking.records import FIRST_SEED, CheckedEpisode, ChildMessage, Records
from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding, Severity
from rlctl.environments.success import SUCCESS

WITH_SEARCH = ("comparisons", "episodes", "starts", "search")  # they play the first process's instance
DISCOUNT = 0.99  # per step: what is hundreds of steps away hardly counts
TERMS = "reward_terms/"
SUM_TOLERANCE = 1e-3  # part of the reward or of 1: terms may be rounded for the log
FEW_WRONG = 0.02  # part of the steps: the last of an episode may have a bonus
REST_STEPS = 3  # So many steps before and after a jump everything has to stand still
STILL = 1e-6
ENOUGH_STEPS = 50  # With fewer steps no rule judges what never happens
LARGE = 10.0  # root mean square per step; a return is up to a hundred times as much
HUGE = 1_000.0  # a single larger reward spoils the values before it
MEANT_CONSTANT = re.compile(r"(?i)(^|_)(alive(ness)?|surviv\w*|time|steps?|living|life|exist\w*|constant|bias)(_|$)")
STEPS = 50
TOLERANCE = 1e-4  # relative to the reward or to 1: rounding to float32
GOALS = ("achieved_goal", "desired_goal")


def require_readable(records: Records) -> list[CheckedEpisode]:
    """Return the episodes of a step at least, if flags and infos can be read; raises `NotJudged` otherwise."""
    records.require_built()
    if records.forms("step"):
        raise NotJudged("step does not return five values (RL201)")
    if any(form.type != "dict" for _, form in records.forms("info")):
        raise NotJudged("info is not a dict (RL204)")
    return _require_enough([episode for episode in records.require_alone() if episode.steps])


def require_rewarded(records: Records) -> list[CheckedEpisode]:
    """Return the same, if every reward is a finite number."""
    episodes = require_readable(records)
    if not all(episode.reward_is_number.all() for episode in episodes):
        raise NotJudged("the reward is not a number (RL204)")
    if not all(np.isfinite(episode.rewards).all() for episode in episodes):
        raise NotJudged("the reward is not finite (RL601)")
    return episodes


def _require_enough(episodes: list[CheckedEpisode]) -> list[CheckedEpisode]:
    if sum(episode.steps for episode in episodes) < ENOUGH_STEPS:
        raise NotJudged(f"fewer than {ENOUGH_STEPS} steps were recorded")
    return episodes


def _require_terms(records: Records) -> list[CheckedEpisode]:
    episodes = [episode for episode in require_rewarded(records) if has_terms(episode)]
    if not episodes:
        raise NotApplicable("no reward_terms in info")
    return episodes


def has_terms(episode: CheckedEpisode) -> bool:
    """Say whether there are reward terms in info."""
    return any(name.startswith(TERMS) for name in episode.infos)


def find_terms(episode: CheckedEpisode) -> dict[str, NDArray[np.float64]]:
    """Return the reward terms of an episode by name; NaN where one is not in info. Shape (T,) each."""
    terms = {}
    for name, series in episode.infos.items():
        if name.startswith(TERMS):
            values = np.full(episode.steps, np.nan)
            inside = (series.steps >= 1) & (series.steps <= episode.steps)
            values[series.steps[inside] - 1] = series.values[inside]
            terms[name.removeprefix(TERMS)] = values
    return terms


def find_constant_terms(episodes: Sequence[CheckedEpisode]) -> dict[str, float]:
    """Return the terms that have one value at all steps of all episodes."""
    by_name: dict[str, list[NDArray[np.float64]]] = {}
    for episode in episodes:
        for name, values in find_terms(episode).items():
            by_name.setdefault(name, []).append(values)
    terms = {name: np.concatenate(parts) for name, parts in by_name.items() if len(parts) == len(episodes)}
    return {name: float(values[0]) for name, values in terms.items() if (values == values[0]).all()}


def reports_success(episodes: Sequence[CheckedEpisode]) -> bool:
    """Say whether `is_success` is in info, at least sometimes."""
    return any(SUCCESS in episode.infos for episode in episodes)


def has_succeeded(episode: CheckedEpisode) -> bool:
    """Say whether `is_success` was true at any step."""
    return SUCCESS in episode.infos and bool((episode.infos[SUCCESS].values > 0).any())


def ends_in_success(episode: CheckedEpisode) -> bool:
    """Say whether `is_success` was true at the last step."""
    series = episode.infos.get(SUCCESS)
    return series is not None and int(series.steps[-1]) == episode.steps and bool(series.values[-1] > 0)


def discounted_sum(rewards: NDArray[np.float64]) -> float:
    """Return the discounted sum of rewards, from the first of them on."""
    return float(rewards @ DISCOUNT ** np.arange(len(rewards)))


def discounted_steps(reward: float, steps: int) -> float:
    """Return the discounted sum of the same reward for so many steps."""
    return float(reward * (1 - DISCOUNT**steps) / (1 - DISCOUNT))


def summarize(episodes: Sequence[CheckedEpisode]) -> str:
    """Return how much was recorded: `80 episodes with random, zero and searched actions (6,100 steps)`."""
    kinds = list(dict.fromkeys(episode.actions for episode in episodes))
    kinds_text = " and ".join([", ".join(kinds[:-1]), kinds[-1]]) if len(kinds) > 1 else kinds[0]
    return f"{len(episodes)} episodes with {kinds_text} actions ({sum(episode.steps for episode in episodes):,} steps)"


@judges_records("RL601")
def _find_not_finite(records: Records) -> Iterator[RuleFinding]:
    for episode in records.require_alone():
        wrong = np.flatnonzero(~np.isfinite(episode.rewards) & episode.reward_is_number)
        if wrong.size:
            step, value = int(wrong[0]) + 1, str(episode.rewards[wrong[0]])
            evidence = episode.at(step, value=value, expected="finite")
            yield RuleFinding("RL601", f"the reward is {value} at step {step}", evidence)
            return


@judges_records("RL602", *WITH_SEARCH, of_absence=True)
def _find_constant_reward(records: Records) -> Iterator[RuleFinding]:
    episodes = require_rewarded(records)
    constant = float(episodes[0].rewards[0])
    if any((episode.rewards != constant).any() or episode.terminated.any() for episode in episodes):
        return
    at_success = any(has_succeeded(episode) for episode in episodes)
    also = ", also where is_success is true" if at_success else ""
    message = f"the reward is {constant:g} at every step of {summarize(episodes)}{also}; nothing ends an episode early"
    evidence = {"value": constant, "episodes": len(episodes), "steps": sum(episode.steps for episode in episodes)}
    severity = Severity.WARNING if constant > 0 or at_success else Severity.INFO
    yield RuleFinding("RL602", message, evidence, severity)


@judges_records("RL603")
def _find_badly_scaled(records: Records) -> Iterator[RuleFinding]:
    require_rewarded(records)
    episodes = [episode for episode in records.role("episodes") if episode.steps]
    if not episodes:
        return
    inner = np.concatenate([episode.rewards[: episode.steps - episode.has_ended] for episode in episodes])
    size = float(np.sqrt(np.mean(inner**2))) if inner.size else 0.0
    largest = max(episodes, key=lambda episode: float(np.abs(episode.rewards).max()))
    step = int(np.abs(largest.rewards).argmax())
    value = float(largest.rewards[step])
    if size > LARGE:
        message = f"the reward per step is {size:.3g} (root mean square), up to {value:.3g}"
    elif abs(value) > HUGE:
        message = f"the reward is {value:.3g} at step {step + 1}; usual is {size:.2g}"
    else:
        return
    evidence = largest.at(step + 1, value=value, root_mean_square=size, expected=[-LARGE, LARGE])
    yield RuleFinding("RL603", message, evidence, Severity.INFO if records.normalizes("reward") else Severity.WARNING)


@judges_records("RL612", *WITH_SEARCH, of_absence=True)
def _find_constant_penalty(records: Records) -> Iterator[RuleFinding]:
    episodes = _require_enough(_require_terms(records))
    for name, value in find_constant_terms(episodes).items():
        if value < 0 and not MEANT_CONSTANT.search(name):
            message = f"reward term {name!r} is {value:.6g} at every step of {summarize(episodes)}"
            yield RuleFinding("RL612", message, {"term": name, "value": value, "episodes": len(episodes)})


@judges_records("RL607", *WITH_SEARCH)
def _find_wrong_sum(records: Records) -> Iterator[RuleFinding]:
    episodes = _require_terms(records)
    totals = [np.sum(list(find_terms(episode).values()), axis=0) for episode in episodes]
    rewards = np.concatenate([episode.rewards for episode in episodes])
    off = np.abs(np.concatenate(totals) - rewards) / np.maximum(1.0, np.abs(rewards))
    off = np.nan_to_num(off)  # a step without terms
    wrong, worst = int((off > SUM_TOLERANCE).sum()), int(off.argmax())
    if wrong > FEW_WRONG * len(off):
        episode, step = [(episode, step) for episode in episodes for step in range(1, episode.steps + 1)][worst]
        total, reward = float(np.concatenate(totals)[worst]), float(rewards[worst])
        example = f"at step {step} their sum is {total:.6g} and the reward {reward:.6g}"
        message = f"reward_terms do not add up to the reward in {wrong} of {len(off)} steps: {example}"
        yield RuleFinding("RL607", message, episode.at(step, value=total, expected=reward))


@judges_records("RL615", "episodes", "search")
def _find_jump_at_rest(records: Records) -> Iterator[RuleFinding]:
    require_rewarded(records)
    for episode in records.role("episodes") + records.role("search"):
        size = episode.steps - episode.has_ended
        if episode.actions != "zero" or size < 2 * REST_STEPS or not episode.observations:
            continue
        rewards = episode.rewards[:size]
        still = np.ones(size, np.bool_)
        for series in episode.observations.values():
            if len(series.values) != episode.steps + 1:
                return
            still &= np.abs(np.diff(series.rows, axis=0)).max(axis=1, initial=0.0)[:size] <= STILL
        level = np.asarray(np.abs(np.diff(rewards)) <= STILL * np.maximum(1.0, np.abs(rewards[1:])))
        for at in np.flatnonzero(~level).tolist():
            before, after = slice(max(0, at - REST_STEPS), at), slice(at + 1, at + 1 + REST_STEPS)
            calm = level[before].all() and level[after].all() and still[before].all() and still[at : after.stop].all()
            if len(rewards[before]) == REST_STEPS == len(level[after]) and calm:
                jump = f"from {rewards[at]:.4g} to {rewards[at + 1]:.4g} at step {at + 2}"
                evidence = episode.at(at + 2, value=float(rewards[at + 1]), expected=float(rewards[at]))
                yield RuleFinding("RL615", f"the reward jumps {jump}, but the observation does not change", evidence)
                return


@experiment("hindsight", PROBE, 90, "RL614", share=0.3)
def recompute_rewards(context: Context) -> Iterator[ChildMessage]:
    """Ask for the rewards of steps that have just been rewarded, all at once, as hindsight replay does."""
    instance = context.instance
    compute = getattr(getattr(instance.env, "unwrapped", instance.env), "compute_reward", None)
    leaves = {leaf.path for leaf in instance.leaves}
    if not callable(compute) or not leaves >= {(name,) for name in GOALS}:
        raise NotApplicable("no compute_reward, or no goals in the observation that are arrays")
    episode = EpisodePlayer(instance, FIRST_SEED, max_steps=STEPS)
    taken = [moment for moment in episode if moment.step and moment.is_readable]
    if not taken:
        raise NotJudged("no step could be taken")
    try:
        goals = [np.stack([np.asarray(moment.observation[name]) for moment in taken]) for name in GOALS]
        rewards = np.array([float(moment.reward) for moment in taken])
        infos = np.array([moment.info for moment in taken])
    except (LookupError, TypeError, ValueError):
        raise NotJudged("goals are missing or change their shape (RL101), or types are wrong (RL204)") from None
    try:
        computed = instance.call("compute_reward", lambda: np.asarray(compute(*goals, infos), np.float64))
    except EnvironmentRaised as error:
        message = f"compute_reward, of many goals at once, raises {error}"
        yield RuleFinding("RL614", message, {"steps": len(taken)})
        return
    if computed.shape != rewards.shape:
        message = f"compute_reward of {len(taken)} goals at once returns shape {computed.shape}, not {rewards.shape}"
        yield RuleFinding("RL614", message, {"steps": len(taken)})
        return
    off = np.abs(computed - rewards)
    # Written so that NaN is another reward; where the environment itself gives one, RL601 says so.
    is_other = np.isfinite(rewards) & ~(off <= TOLERANCE * np.maximum(1.0, np.abs(rewards)))
    if is_other.any():
        step = int(np.where(is_other, off, 0.0).argmax())
        returned = f"compute_reward returns {computed[step]:.6g}"
        message = f"the reward of step {step + 1} is {rewards[step]:.6g}, and {returned}"
        evidence = {"step": step + 1, "value": float(computed[step]), "expected": float(rewards[step])}
        yield RuleFinding("RL614", message, evidence)
