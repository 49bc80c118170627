"""The experiment `episodes`: plays whole episodes with actions of every kind."""

from collections.abc import Iterator

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, ChildMessage, Shortened
from rlctl.checking.rule import NotJudged
from rlctl.checking.values import read_generators, watch_unseeded

EPISODES = (
    *("random", "zero", "extreme", "rare", "repeated", "random", "random", "random"),
    *("extreme", "zero", "random", "rare", "extreme", "random", "extreme", "repeated"),
)
"""How the actions of each episode are chosen: every kind first, in case `MOST_STEPS` are over."""
ENOUGH_EPISODES = 5  # of a slow environment: one of each kind
MOST_STEPS = 5_000  # in all; more episodes with other seeds show little more
ENDLESS_STEPS = 3_000  # an episode without an end is stopped after so many steps
LATER_ENDLESS_STEPS = 500  # The same, once one had no end


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
            context.note_episode(episode.steps, episode.ended)
            longest = LATER_ENDLESS_STEPS if episode.ended == "steps" else longest
            if steps >= MOST_STEPS:
                return
