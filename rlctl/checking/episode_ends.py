"""How the recorded episodes ended."""

from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rule import NotJudged

FEWEST_EPISODES = 5
SHORTEST_TIE = 20  # so long are episodes that end together at a time limit, where others end earlier [steps]


def require_episodes(records: Records) -> list[CheckedEpisode]:
    """Return the whole episodes that did not raise; raises `NotJudged` where there is none."""
    episodes = [episode for episode in records.role("episodes") if episode.ended != "raised"]
    if not episodes:
        raise NotJudged(records.skipped.get("episodes", "no episode could be played"))
    return episodes


def require_two_flags(records: Records) -> None:
    """Raise `NotJudged` if step returns one flag for both ends."""
    if records.forms("step"):
        raise NotJudged("step returns one flag for both (RL201)")


def use_registration(records: Records) -> str:
    """Return the fix for a class without a time limit that is registered with one; empty for any other."""
    built = records.require_built()
    is_limited = built.max_steps is None and "max_episode_steps" in built.registered
    return f"Use its registration: the class is {built.registered}" if is_limited else ""
