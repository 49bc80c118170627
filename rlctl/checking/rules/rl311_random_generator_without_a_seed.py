"""RL311: random generator without a seed."""

import contextlib
from collections.abc import Iterator

from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.experiments.episodes import record_episodes
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.values import find_assignment, read_attributes, read_generators

RULE = Rule(
    "RL311",
    "random generator without a seed",
    Severity.ERROR,
    meaning="""
        The environment draws from a random generator that reset(seed=...) does not seed, perhaps only in rare
        situations. These episodes cannot be repeated, and a run cannot be resumed exactly.
    """,
    fix="""
        Draw from self.np_random, which super().reset(seed=seed) seeds, and pass it to the parts of the
        environment.
    """,
    task_fix="""
        Draw only from `rng`, the argument of reset; use no np.random.*, random.*, default_rng() or time.
    """,
    shows_one=True,
)

RESETS = 4  # of which two leave the same


@experiment("unseeded generators", PROBE, 80, RULE, share=0.1)
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
        yield RuleFinding(RULE, message, {"seed": FIRST_SEED}, where=(file, line))
    instance.reset(FIRST_SEED)
    after = read_generators(instance.env)
    moved = [name for name, state in after.items() if (context.generators or {}).get(name, state) != state]
    for name in moved:
        if not _is_restored(instance, name):
            message = f"{name} is used, and reset(seed={FIRST_SEED}) does not restore its state"
            where = find_assignment(instance.env, name)
            yield RuleFinding(RULE, message, {"element": name, "seed": FIRST_SEED}, where=where)
            return


def _is_restored(instance: Instance, name: str) -> bool:
    """Say whether a reset restores a generator that has been drawn from: where a reset draws more often or less after
    another episode, only the state that it leaves differs (RL303)."""
    seen: set[str] = set()
    for _ in range(RESETS):
        generator = read_attributes(instance.env).get(name)
        if generator is None:
            return False
        generator.value.random()
        instance.reset(FIRST_SEED)
        state = read_generators(instance.env).get(name, "")
        if state in seen:
            return True
        seen.add(state)
    return False
