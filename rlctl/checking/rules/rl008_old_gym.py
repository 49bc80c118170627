"""RL008: old gym."""

from collections.abc import Iterator
from typing import Any

from rlctl.checking.experiments.build import FailedBuild, explains_failures, judges_built
from rlctl.checking.instance import Instance, get_causes
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.errors import OldGymError

RULE = Rule(
    "RL008",
    "old gym",
    Severity.ERROR,
    meaning="""
        The environment is written for the old `gym` package, which is no longer maintained: Gymnasium does not
        find its registrations, and today's libraries do not accept it. Or its class is Gymnasium's and its spaces
        are not.
    """,
    fix="""
        Replace `import gym` by `import gymnasium as gym`, register with gymnasium.register, return
        (observation, info) from reset and five values from step.
    """,
    needs_instance=False,
)

SPACES = "Import the spaces from Gymnasium too: `from gymnasium import spaces`."


@explains_failures(RULE, place=20)
def _explain_old_gym(failed: FailedBuild) -> Iterator[RuleFinding]:
    missing_modules = [str(e.name) for e in get_causes(failed.cause) if isinstance(e, ModuleNotFoundError)]
    is_missing = any(name.partition(".")[0] == "gym" for name in missing_modules)
    if isinstance(failed.error, OldGymError) or is_missing:
        yield RuleFinding(RULE, failed.message, failed.details, fix=failed.to_install)


@judges_built(RULE)
def _find_old_base_class(instance: Instance) -> Iterator[RuleFinding]:
    if inherits_from_old_gym(instance.env):
        yield RuleFinding(RULE, "the class inherits from gym.Env, not from gymnasium.Env")
        return
    for name, leaves in (("observation_space", instance.leaves), ("action_space", instance.action_leaves)):
        kind = next((leaf.kind for leaf in leaves if leaf.kind.startswith("gym.")), None)
        if kind is not None:
            message = f"{name} is made of {kind.replace('gym.', 'gym.spaces.')}, which is no space of Gymnasium"
            yield RuleFinding(RULE, message, {"element": name, "value": kind}, fix=SPACES)
            return


def inherits_from_old_gym(env: Any) -> bool:
    """Say whether an environment's class has one of the package `gym` among its bases."""
    bases = type(getattr(env, "unwrapped", env)).__mro__
    return any(base.__module__.partition(".")[0] == "gym" for base in bases)
