"""RL5: how episodes end."""

import contextlib
from collections.abc import Iterator

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment, judges_records
from rlctl.checking.instance import Context
from rlctl.checking.recording import Recording
from rlctl.checking.records import ENDS, FIRST_SEED, CheckedEpisode, ChildMessage, Records, Shortened
from rlctl.checking.rule import NotJudged, RuleFinding, Severity
from rlctl.checking.values import find_assignment, read_generators, watch_unseeded

EPISODES = (
    *("random", "zero", "extreme", "rare", "repeated", "random", "random", "random"),
    *("extreme", "zero", "random", "rare", "extreme", "random", "extreme", "repeated"),
)
"""How the actions of each episode are chosen: every kind first, in case `MOST_STEPS` are over."""
ENOUGH_EPISODES = 5  # of a slow environment: one of each kind
MOST_STEPS = 5_000  # in all; more episodes with other seeds show little more
ENDLESS_STEPS = 3_000  # an episode without an end is stopped after so many steps
LATER_ENDLESS_STEPS = 500  # The same, once one had no end
FEWEST_EPISODES, FEWEST_TIES = 5, 4
SHORTEST_LIMIT = 5  # shorter games with one length have no time limit [steps]
LONGEST_AT_ONCE = 4  # so short episodes are no robot's [steps]
FEWEST_LENGTHS = 2  # With fewer different lengths it may be one that is unlike the others
SHORTEST_TIE = 20  # The same, where only some episodes end together [steps]
ENOUGH_STEPS = 1_000  # shorter episodes without an end are too short to judge


@experiment("episodes", PROBE, 50, share=6.0)
def record_episodes(context: Context) -> Iterator[ChildMessage]:
    """Play whole episodes with actions of every kind."""
    instance, budget, steps, longest = context.instance, context.budget, 0, ENDLESS_STEPS
    instance.reset(FIRST_SEED)
    context.generators = read_generators(instance.env)
    with watch_unseeded(context.unseeded_calls):
        for number, kind in enumerate(EPISODES):
            if why := budget.why_spent():
                if number >= ENOUGH_EPISODES and budget.is_over():
                    budget.was_cut = False
                    yield Shortened("episodes", f"{number} of {len(EPISODES)} episodes")
                    return
                raise NotJudged(f"{number} of {len(EPISODES)} episodes were played: {why}")
            seed, longest_s = FIRST_SEED + number, budget.seconds_left / 2
            episode = EpisodePlayer(instance, seed, kind, number=number, max_steps=longest, longest_s=longest_s)
            yield from Recording("episodes", episode).run()
            steps += episode.steps
            longest = LATER_ENDLESS_STEPS if episode.ended == "steps" else longest
            if steps >= MOST_STEPS:
                return


@experiment("unseeded generators", PROBE, 80, "RL311", share=0.1)
def find_unseeded(context: Context) -> Iterator[ChildMessage]:
    """Reset with the first seed, and compare the states of all generators with those after the first reset."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    if context.generators is None:  # no other rule needs the episodes
        with contextlib.suppress(NotJudged):
            yield from record_episodes.run(context)
    for file, line in sorted(context.unseeded_calls)[:1]:
        message = "reset or step creates a random generator without a seed: default_rng()"
        yield RuleFinding("RL311", message, {"seed": FIRST_SEED}, where=(file, line))
    instance.reset(FIRST_SEED)
    after = read_generators(instance.env)
    moved = [name for name, state in after.items() if (context.generators or {}).get(name, state) != state]
    for name in moved[:1]:
        message = f"{name} is used, and reset(seed={FIRST_SEED}) does not restore its state"
        where = find_assignment(instance.env, name)
        yield RuleFinding("RL311", message, {"element": name, "seed": FIRST_SEED}, where=where)


def _require_episodes(records: Records) -> list[CheckedEpisode]:
    episodes = [episode for episode in records.role("episodes") if episode.ended != "raised"]
    if not episodes:
        raise NotJudged(records.skipped.get("episodes", "no episode could be played"))
    return episodes


def _require_two_flags(records: Records) -> None:
    if records.forms("step"):
        raise NotJudged("step returns one flag for both (RL201)")


@judges_records("RL501", "episodes", "search")  # of absence too, but for the counter
def _find_time_limit_as_terminated(records: Records) -> Iterator[RuleFinding]:
    episodes = _require_episodes(records)
    _require_two_flags(records)
    if any(episode.ended in ("truncated", "both") for episode in episodes):
        return
    ended = [episode for episode in episodes if episode.ended == "terminated"]
    limit = max((episode.steps for episode in ended), default=0)
    if counter := (built := records.require_built()).counter:
        message = f"step sets terminated by a counter ({counter}), and truncated is always False"
        flags = {"value": "terminated", "expected": "truncated"}
        yield RuleFinding("RL501", message, flags, where=built.counter_place)
        return
    records.require_whole("episodes", "search")
    longer = [episode for episode in episodes if episode.ended not in ENDS] + records.role("search")
    if any(episode.steps > limit for episode in longer):
        return
    if len(ended) < FEWEST_EPISODES or len({episode.actions for episode in ended}) < 2:
        raise NotJudged(f"only {len(ended)} episodes ended")
    ties = [episode for episode in ended if episode.steps == limit]
    of = {"episodes": len(ties), "of": len(episodes)}
    evidence = {"step": limit, **of, "value": "terminated", "expected": "truncated"}
    has_obstacle = all(_ends_with_odd_reward(episode) for episode in ties)
    if limit >= SHORTEST_LIMIT and len(ties) == len(episodes):
        message = f"all {len(ties)} episodes, whatever the actions, end at step {limit} with terminated=True"
        if has_obstacle:
            message += ", and with a reward unlike any before: a time limit, or an obstacle that none of them passes"
        yield RuleFinding("RL501", message, evidence, Severity.INFO if has_obstacle else None)
    elif limit >= SHORTEST_TIE and len(ties) >= FEWEST_TIES and len({episode.actions for episode in ties}) > 1:
        message = f"{len(ties)} of {len(episodes)} episodes end at step {limit} with terminated=True, none later"
        yield from () if has_obstacle else (RuleFinding("RL501", message, evidence),)


def _ends_with_odd_reward(episode: CheckedEpisode) -> bool:
    before, last = episode.rewards[:-1], episode.rewards[-1]
    return bool(before.size and (last < before.min() or last > before.max()))


@judges_records("RL502", "episodes", of_absence=True)
def _find_both_flags(records: Records) -> Iterator[RuleFinding]:
    episodes = _require_episodes(records)
    both = [episode for episode in episodes if episode.ended == "both"]
    if len(both) >= 2 and not any(episode.ended == "truncated" for episode in episodes):
        message = f"{len(both)} episodes end with terminated=True and truncated=True, none with truncated alone"
        yield RuleFinding("RL502", message, both[0].at(both[0].steps, value=len(both), expected=0))


@judges_records("RL507", "episodes", of_absence=True)
def _find_failure_as_truncated(records: Records) -> Iterator[RuleFinding]:
    episodes = _require_episodes(records)
    lengths = [episode.steps for episode in episodes if episode.ended == "truncated"]
    limit = records.require_built().max_steps or max(lengths, default=0)
    early = [steps for steps in lengths if steps < limit]
    steps = sorted(set(early))
    if any(episode.terminated.any() for episode in episodes) or len(steps) < FEWEST_LENGTHS:
        return
    message = f"{len(early)} of {len(episodes)} episodes are truncated before step {limit}, at {len(steps)} different "
    yield RuleFinding("RL507", f"{message}steps, and none is terminated", {"value": steps, "expected": limit})


@judges_records("RL503", "episodes", of_absence=True)
def _find_endless(records: Records) -> Iterator[RuleFinding]:
    limit, episodes = records.require_built().max_steps, _require_episodes(records)
    if any(episode.ended == "truncated" for episode in episodes):
        return
    longest: dict[str, int] = {}
    for episode in episodes:
        if not episode.has_ended:
            longest[episode.actions] = max(longest.get(episode.actions, 0), episode.steps)
    if not any(longest.values()):
        return
    if max(longest.values()) < (limit or ENOUGH_STEPS):
        raise NotJudged(f"no end within {max(longest.values())} steps; longer episodes are not played")
    declared = f"its own limit is {limit}" if limit else "no time limit is known"
    steps = ", ".join(f"{count:,} with {kind} actions" for kind, count in longest.items())
    message = f"no episode ended after so many steps: {steps}; {declared}"
    yield RuleFinding("RL503", message, {"steps": longest, "expected": limit}, fix=_use_registration(records))


@judges_records("RL504", "episodes")
def _find_end_at_once(records: Records) -> Iterator[RuleFinding]:
    episodes = _require_episodes(records)
    built, longest = records.require_built(), max(episode.steps for episode in episodes)
    is_robot = all(leaf.kind == "Box" and "float" in leaf.dtype for leaf in (*built.leaves, *built.action_leaves))
    all_ended = len(episodes) >= FEWEST_EPISODES and all(episode.has_ended for episode in episodes)
    if all_ended and longest <= (LONGEST_AT_ONCE if is_robot else 1):
        message = f"all {len(episodes)} episodes end on step 1" + f" to {longest}" * (longest > 1)
        yield RuleFinding("RL504", message, {"step": longest, "episodes": len(episodes)})


@judges_records("RL506", "episodes", "search", of_absence=True)
def _find_no_time_limit(records: Records) -> Iterator[RuleFinding]:
    built, episodes = records.require_built(), _require_episodes(records)
    if built.max_steps is not None or any(episode.ended != "terminated" for episode in episodes):
        return  # those that did not end are RL503's
    lengths = [episode.steps for episode in episodes]
    is_continuous = any(leaf.kind == "Box" and leaf.dtype.startswith("float") for leaf in built.leaves)
    if len(set(lengths)) == 1 or (max(lengths) < SHORTEST_TIE and not is_continuous):
        return  # a bandit, or a game of a few moves
    _require_two_flags(records)
    if list(_find_time_limit_as_terminated.run(records)):
        raise NotJudged("a time limit seems to be flagged as terminated (RL501)")
    if built.truncation == "computed":
        return  # its limit was not reached
    why = "step always returns truncated=False" if built.truncation == "never" else "none is declared or was reached"
    ends = f"all {len(episodes)} episodes ended with terminated=True, the longest after {max(lengths)} steps"
    evidence = {"episodes": len(episodes), "value": None, "expected": "max_episode_steps", "step": max(lengths)}
    severity = Severity.WARNING if is_continuous and built.truncation == "never" else Severity.INFO
    message = f"no time limit was seen: {why}; {ends}"
    yield RuleFinding("RL506", message, evidence, severity, fix=_use_registration(records))


def _use_registration(records: Records) -> str:
    """Return the fix for a class without a time limit that is registered with one; empty for any other."""
    built = records.require_built()
    is_limited = built.max_steps is None and "max_episode_steps" in built.registered
    return f"Use its registration: the class is {built.registered}" if is_limited else ""
