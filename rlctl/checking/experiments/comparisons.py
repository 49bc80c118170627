"""The experiment `comparisons`: plays an episode again in several ways."""

from collections.abc import Iterator

from rlctl.checking.differences import COMPARED_STEPS
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.kept_state import KeptState, find_kept, read_state
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Fact

DIRTY_STEPS = 37  # longest unfinished episode before a repetition
KEPT_STEPS = 10  # So many steps are between two resets whose attributes are compared


@experiment("comparisons", PROBE, 20, share=4.0)
def compare_repetitions(context: Context) -> Iterator[ChildMessage]:
    """Play the first episode again: at once, after an unfinished other one, and with another seed."""
    instance, budget = context.instance, context.budget
    longest_s, steps = budget.seconds_left / 4, COMPARED_STEPS
    for number, role in enumerate(("alone", "reused", "dirty", "seeds")):
        instance.progress.phase(role)
        if role == "dirty":
            unfinished = min(DIRTY_STEPS, max(1, steps // 2))
            Recording(role, EpisodePlayer(instance, SECOND_SEED, "extreme", max_steps=unfinished)).run()
        if budget.is_over():
            return
        seed, first = SECOND_SEED if role == "seeds" else FIRST_SEED, FIRST_SEED
        episode = EpisodePlayer(
            instance, seed, number=number, action_seed=first, max_steps=COMPARED_STEPS, longest_s=longest_s
        )
        yield from Recording(role, episode).run()
        steps = min(steps, episode.steps)
    yield Fact("kept", _find_kept(instance))


def _find_kept(instance: Instance) -> list[KeptState]:
    read = []
    for steps in (0, KEPT_STEPS, 0):
        moment = EpisodePlayer(instance, FIRST_SEED, max_steps=0).reset()
        read.append(read_state(instance, moment.observation))
        for _ in EpisodePlayer(instance, SECOND_SEED, max_steps=steps):
            pass
    return find_kept(*read)
