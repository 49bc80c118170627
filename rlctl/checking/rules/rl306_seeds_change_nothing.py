"""RL306: seeds change nothing."""

import ast
import itertools
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import read_name
from rlctl.checking.differences import compare
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.goal_starts import GoalStarts
from rlctl.checking.records import Records
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.source_code import FaultyCode, write_code

RULE = Rule(
    "RL306",
    "seeds change nothing",
    Severity.INFO,
    meaning="""
        All seeds give the same start and, with the same actions, the same trajectory: a policy may memorise it.
        Some tasks are fixed (a puzzle, a maze), so this is only an info. A fixed start with random steps is no
        finding. It is a warning where reset draws a goal that is then replaced or never read, or that only the first
        reset draws, and where each reset makes a generator from one number.
    """,
    fix="""
        If the task should vary, draw the start from self.np_random in reset, after super().reset(seed=seed).
    """,
    task_fix="If the task should vary, draw the start from `rng`, the argument of reset.",
    shows_one=True,
)

FEWEST_SEEDS = 4
GENERATORS = {"default_rng", "RandomState"}


@judges_expressions(RULE, decides=False)
def _find_vain_draws(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    starts = noted.share(GoalStarts)
    found = itertools.chain(starts.find_vain_draws(), starts.find_first_draws(), _find_generators(noted))
    for one in itertools.islice(found, 1):
        evidence = {"element": write_code(one.node)}
        yield RuleFinding(RULE, one.what, evidence, Severity.WARNING, where=one.where)


def _find_generators(noted: NotedEpisodes) -> Iterator[FaultyCode]:
    """Yield generators that each reset makes from one number: they draw the same in each episode."""
    for function in noted.functions:
        for node in ast.walk(function) if function in noted.of_resets and function.name != "__init__" else ():
            match node:
                case ast.Call(func=called, args=[ast.Constant(value=int(seed))]) if read_name(called) in GENERATORS:
                    what = f"{write_code(node)}: each reset draws what the seed {seed} gives, whatever its own seed is"
                    yield FaultyCode(node, what, noted.source.find_place(node))


@judges_records(RULE, "comparisons", "episodes", of_absence=True)
def _compare_seeds(records: Records) -> Iterator[RuleFinding]:
    if compare(records, "alone", "seeds") is not None:
        return
    starts = [episode for episode in records.require_alone() if 0 in episode.observations]
    if (seeds := len({start.seed for start in starts})) < FEWEST_SEEDS:
        raise NotJudged(f"fewer than {FEWEST_SEEDS} seeds were tried")
    for index, _ in enumerate(records.require_built().leaves):
        values = [start.observations[index].values[0] for start in starts if index in start.observations]
        if any(not np.array_equal(values[0], other) for other in values[1:]):
            return
    steps = records.require_role("alone").steps
    message = f"{seeds} seeds give one start, and with the same actions one trajectory of {steps} steps"
    yield RuleFinding(RULE, message, {"seeds": seeds, "value": 1, "expected": seeds})
