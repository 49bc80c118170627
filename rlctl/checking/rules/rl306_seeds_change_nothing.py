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
from rlctl.checking.term_names import split_name

RULE = Rule(
    "RL306",
    "seeds change nothing",
    Severity.INFO,
    meaning="""
        All seeds give the same start and, with the same actions, the same trajectory: a policy may memorise it.
        Some tasks are fixed (a puzzle, a maze), so this is only an info. A fixed start with random steps is no
        finding. It is a warning where reset draws a goal that is then replaced or never read, or that only the first
        reset draws, and where each reset makes a generator from one number, or gives one to super().reset.
    """,
    fix="""
        If the task should vary, draw the start from self.np_random in reset, after super().reset(seed=seed).
    """,
    task_fix="If the task should vary, draw the start from `rng`, the argument of reset.",
    shows_one=True,
)

FEWEST_SEEDS = 4
FEWEST_RESETS = 3  # with different seeds
GENERATORS = {"default_rng", "RandomState", "Random", "np_random", "PCG64", "MT19937", "Philox", "SeedSequence"}
SEED_WORDS = {"seed", "base", "default", "first", "initial", "last", "random", "rng", "start"}
"""Of the names of a seed."""


@judges_expressions(RULE, decides=False)
def _find_vain_draws(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    starts = noted.share(GoalStarts)
    found = itertools.chain(starts.find_vain_draws(), starts.find_first_draws(), _find_generators(noted))
    for one in itertools.islice(found, 1):
        evidence = {"element": write_code(one.node)}
        yield RuleFinding(RULE, one.what, evidence, Severity.WARNING, where=one.where)


def _find_generators(noted: NotedEpisodes) -> Iterator[FaultyCode]:
    """Yield generators that each reset makes from one number, or seeds with one: they draw the same in each episode."""
    for function in noted.functions:
        for node in ast.walk(function) if function in noted.of_resets and function.name != "__init__" else ():
            if not isinstance(node, ast.Call):
                continue
            seed = _read_seed(node)
            if seed is not None and (number := _read_number(noted, seed)) is not None:
                what = f"{write_code(node)}: each reset draws what the seed {number} gives, whatever its own seed is"
                yield FaultyCode(node, what, noted.source.find_place(node))


def _read_seed(call: ast.Call) -> ast.expr | None:
    """Return from what a call makes or seeds a generator; None for other calls."""
    name = read_name(call.func)
    is_own_reset = name == "reset" and ast.unparse(call.func) == "super().reset"
    if name in GENERATORS and call.args:
        return call.args[0]
    return next((word.value for word in call.keywords if word.arg == "seed"), None) if is_own_reset else None


def _read_number(noted: NotedEpisodes, seed: ast.expr) -> int | None:
    """Return the number that a seed is in each reset, where it is written so or called a seed; resets that were
    played had different seeds."""
    match seed:
        case ast.Constant(value=int(number)):
            return number
        case ast.Name() | ast.Attribute() if {*split_name(read_name(seed))} <= SEED_WORDS:
            found = noted.source.find(seed)
            values = [
                value
                for episode in noted.episodes
                for value in (episode[0].values.get(found.number, ()) if found else ())
            ]
            if len(values) >= FEWEST_RESETS and len({repr(value) for value in values}) == 1:
                return int(values[0]) if isinstance(values[0], float) else None
    return None


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
