"""RL621: penalty that pays."""

import ast
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.paid_costs import CostReader
from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rewards import (
    RAW_TERMS,
    WITH_SEARCH,
    find_terms,
    find_wrong_sums,
    join_terms,
    reports_success,
    require_enough,
    require_terms,
    summarize,
)
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.term_names import is_about_actions, is_about_goals, is_about_time, is_cost, is_error
from rlctl.checking.upright_costs import find_upright_costs

RULE = Rule(
    "RL621",
    "penalty that pays",
    Severity.WARNING,
    meaning="""
        A reward term that should lower the reward raises it: its weight is negative and the term too, or it has
        no minus; weights that info does not have are estimated from the rewards. The policy learns to seek what
        the term should prevent. Judged are terms of a task with a negative weight that are named after an error
        or a cost; costs of actions that pay more for moving than for doing nothing; a constant that is called a
        cost, or is named after time where other terms are about a goal; and, as an info, other terms that are
        called cost or penalty. In the source, a cost that squares the vertical part of a direction, which is 1 where
        the robot stands upright; the size of an action or of an error that is added, since a minus is missing or is
        there twice; what is paid where the robot falls; and the wrong side of a limit, as in -min(0, force - limit).
    """,
    fix="Return the term without a sign, such as a distance or a squared action, and put the sign in the weight.",
)

LEVEL = "Square the other two parts, which are 0 upright."
MOVING_PAYS = 2.0  # times as much as doing nothing


@judges_expressions(RULE, decides=False)
def _find_paid_costs(notes: NotedEpisodes) -> Iterator[RuleFinding]:
    for summand, part in find_upright_costs(notes):
        message = f"reward term {summand.name!r} is a cost, and squares {ast.unparse(part)}, the vertical part of a"
        message += " direction: it is largest where the robot stands upright, and falls as it tilts"
        yield RuleFinding(RULE, message, {"term": summand.name}, where=notes.reward.locate(summand.place), fix=LEVEL)
        return
    for paid in CostReader(notes).find():
        text = ast.unparse(paid.place.node)
        message = f"reward term {paid.summand.name!r} counts {paid.summand.weight:+.4g} times, and {text} {paid.why}"
        line = notes.reward.locate(paid.summand.place)
        same = ("RL622",) if paid.is_of_error else ()
        yield RuleFinding(RULE, message, {"term": paid.summand.name}, where=line, same=same)
        return


@judges_records(RULE, *WITH_SEARCH)
def _find_paying_penalties(records: Records) -> Iterator[RuleFinding]:
    episodes = require_enough(require_terms(records))
    if find_wrong_sums(episodes).any():
        raise NotJudged("reward_terms do not add up to the reward (RL607)")
    raw_terms = join_terms(episodes, RAW_TERMS)
    terms = join_terms(episodes)
    has_goal = reports_success(episodes) and any(is_about_goals(name) for name in terms)
    for name, values in terms.items():
        if not (values >= 0).all():
            continue
        if (values == values[0]).all():
            if values[0] > 0 and (is_cost(name) or (has_goal and is_about_time(name))):
                message = f"reward term {name!r} pays {values[0]:.6g} at every step of {summarize(episodes)}"
                longest = records.require_built().max_steps or max(one.steps for one in episodes)
                message += (
                    f": an episode of {longest} steps earns {longest * values[0]:.4g} of it, and an early end less"
                )
                yield RuleFinding(RULE, message, {"term": name, "value": float(values[0]), "episodes": len(episodes)})
            continue
        message = f"reward term {name!r} raises the reward at every step of {summarize(episodes)}"
        if not values.all():
            message = f"reward term {name!r} raises the reward, and never lowers it, in {summarize(episodes)}"
        raw = raw_terms.get(name)
        if raw is not None and raw.min() < 0 and is_error(name):  # their product is positive
            message, severity = f"{message}: its weight and the term itself are both negative", Severity.WARNING
        elif is_about_actions(name) and _pays_for_moving(episodes, name):
            message, severity = f"{message}: moving earns more of it than doing nothing", Severity.WARNING
        elif is_cost(name):
            severity = Severity.INFO
        else:
            continue
        evidence = {"term": name, "value": float(values.max()), "episodes": len(episodes)}
        yield RuleFinding(RULE, message, evidence, severity)


def _pays_for_moving(episodes: Sequence[CheckedEpisode], name: str) -> bool:
    """Say whether a term is clearly larger with random and extreme actions than with none."""
    idle = _read_term([episode for episode in episodes if not episode.taken.any()], name)
    moving = _read_term([episode for episode in episodes if episode.actions in ("random", "extreme")], name)
    return bool(idle.size and moving.size and moving.mean() > MOVING_PAYS * idle.mean())


def _read_term(episodes: Sequence[CheckedEpisode], name: str) -> NDArray[np.float64]:
    parts = [find_terms(episode)[name] for episode in episodes]
    return np.concatenate(parts) if parts else np.zeros(0)
