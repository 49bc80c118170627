"""The families of rules: their experiments and checks.

**An experiment** does something with an environment in a child process and yields what it finds:

    @experiment("rendering", "RL215", share=0.5)
    def render(context: Context) -> Iterator[ChildMessage]:
        with context.fresh("rgb_array") as instance:
            instance.reset(FIRST_SEED)
            if not isinstance(picture := instance.call("render", instance.env.render), np.ndarray):
                yield RuleFinding("RL215", "render returns no array", {"value": str(picture)})

It decides the rules that it names, if it completes. `raise NotJudged(why)` or `NotApplicable(why)` ends it, and applies
to all its rules without a finding; `yield Skipped("RL404", why)` applies to one. It calls the environment only through
`Instance.call`, `Instance.reset` and `EpisodePlayer`: its exceptions are then `EnvironmentRaised`, which need not be
caught, and hangs and crashes can be located. `context.budget` limits time and memory.

**A check** judges one rule in the parent process, from recorded episodes, which many rules share:

    @check("RL502", "episodes")
    def find_both_flags(records: Records) -> Iterator[RuleFinding]:
        for episode in records.role("episodes"): ...

It names the experiments that it needs (by default `RECORDING`, which record the common episodes) and may raise
`NotJudged` or `NotApplicable`. A rule may have an experiment and a check. An experiment that records episodes yields
what `Recording.run()` returns. Name, severity, meaning and fix of a rule are in `rules.yaml`; a finding has its own
severity or fix only if they differ.
"""

import importlib
import pkgutil
from collections.abc import Collection

from rlctl.checking.experiments import Check, Experiment
from rlctl.checking.rules import RULES

PROCESS_S = 18.0  # for the experiments of one process [s], besides importing and building
MOST_GROWTH = 5.0  # times longer, for an environment whose steps are slow

_MODULES = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
_MEMBERS = [value for module in _MODULES for value in vars(module).values()]
CHECKS = {member.rule: member for member in _MEMBERS if isinstance(member, Check)}
EXPERIMENTS = {member.name: member for member in _MEMBERS if isinstance(member, Experiment)}
DECIDED_BY = {rule: experiment for experiment in EXPERIMENTS.values() for rule in experiment.rules}

PROCESSES = {
    "probe": (
        *("build", "comparisons", "global random", "speed", "episodes", "starts", "search", "unseeded generators"),
        *("hindsight", "leaks", "goals"),
    ),
    "instances": (
        *("instances", "worlds", "batches", "mirror", "unseeded", "action effects"),
        *("hidden state", "nan action", "variants", "rendering"),
    ),
}
"""The experiments of each child process, in their order: the most important rules first, and what may crash last."""
HASH_SEEDS = {"probe": 0, "instances": 1}  # of Python's hashes: they differ, so that a dependence on their order shows


def find_needs(rules: Collection[str]) -> set[str]:
    """Return the names of the experiments that some rules need."""
    checked = {name for rule in rules if rule in CHECKS for name in CHECKS[rule].needs}
    return checked | {DECIDED_BY[rule].name for rule in rules if rule in DECIDED_BY}


def find_rules(experiments: Collection[str]) -> list[str]:
    """Return the ids of the rules that some experiments can say something about."""
    return [rule for rule in RULES if find_needs([rule]) & set(experiments)]
