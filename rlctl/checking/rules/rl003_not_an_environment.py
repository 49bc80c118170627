"""RL003: not an environment."""

from collections.abc import Iterator

import gymnasium

from rlctl.checking.experiments.build import FailedBuild, explains_failures, judges_built
from rlctl.checking.instance import Instance
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.rules.rl008_old_gym import inherits_from_old_gym
from rlctl.environments import registry
from rlctl.errors import TaskError

RULE = Rule(
    "RL003",
    "not an environment",
    Severity.ERROR,
    meaning="""
        The object lacks what every library expects: the methods, the spaces, or Gymnasium's base class.
    """,
    fix="""
        Inherit from gymnasium.Env and define reset, step, observation_space and action_space from
        gymnasium.spaces.
    """,
    needs_instance=False,
)


@explains_failures(RULE, place=70)
def _explain_other_object(failed: FailedBuild) -> Iterator[RuleFinding]:
    error = failed.error
    is_without_trace = isinstance(error, TaskError) and error.details is None  # a constructor's error has one
    if is_without_trace and not registry.is_task(registry.load(failed.context.spec.task)):
        what_to_do = str(error).partition("\n")[2]
        fix = f"{what_to_do[:1].upper()}{what_to_do[1:]}"
        yield RuleFinding(RULE, failed.message_from_first, fix=fix)


@judges_built(RULE)
def _find_what_is_missing(instance: Instance) -> Iterator[RuleFinding]:
    if not inherits_from_old_gym(instance.env) and not isinstance(instance.env, gymnasium.Env):
        yield RuleFinding(RULE, "the class does not inherit from gymnasium.Env")
    for name, leaves in (("observation", instance.leaves), ("action", instance.action_leaves)):
        if "NoneType" in {leaf.kind for leaf in leaves}:
            yield RuleFinding(RULE, f"there is no {name}_space")
