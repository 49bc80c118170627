"""All rules and experiments, found in the files of the packages `rules` and `experiments`."""

import pkgutil
import sys
from collections.abc import Collection, Sequence
from types import ModuleType

from rlctl.checking import experiments, rules
from rlctl.checking.experiment import HASH_SEEDS, RecordsJudge, import_experiments, index
from rlctl.checking.experiments.expressions import judges_expressions, note_expressions
from rlctl.checking.rule import Rule
from rlctl.errors import UsageError, did_you_mean

PROCESS_S = 18.0  # for the experiments of one process [s], besides importing and building
MOST_GROWTH = 5.0  # times longer, for an environment whose steps are slow


FAMILIES = {
    "RL0": "loading",
    "RL1": "spaces and observations",
    "RL2": "interface",
    "RL3": "determinism",
    "RL4": "isolation and resources",
    "RL5": "episodes",
    "RL6": "reward",
    "RL7": "actions",
    "RL8": "physics (PyBullet and MuJoCo)",
    "RL9": "speed",
}
"""The titles of the families, by the beginning of their ids."""


def _list_modules(package: ModuleType) -> list[str]:
    return [f"{package.__name__}.{module.name}" for module in pkgutil.iter_modules(package.__path__)]


_EXPERIMENTS = import_experiments([*_list_modules(rules), *_list_modules(experiments)])
_MODULES = {sys.modules[name].RULE.id: name for name in _list_modules(rules)}
_MEMBERS = [value for name in _MODULES.values() for value in vars(sys.modules[name]).values()]

RULES: dict[str, Rule] = {rule: sys.modules[name].RULE for rule, name in sorted(_MODULES.items())}
JUDGES = index((value.rule, value) for value in _MEMBERS if isinstance(value, RecordsJudge))
EXPERIMENTS = {one.name: one for one in sorted(_EXPERIMENTS.values(), key=lambda one: one.place)}
DECIDED_BY = index((rule, one) for one in EXPERIMENTS.values() for rule in one.rules)
PROCESSES = {
    process: tuple(one.name for one in EXPERIMENTS.values() if one.process == process) for process in HASH_SEEDS
}
"""The experiments of each child process, in their order."""


def find_needs(rules: Collection[str]) -> set[str]:
    """Return the names of the experiments that some rules need."""
    judged = {name for rule in rules if rule in JUDGES for name in JUDGES[rule].needs}
    noted = {note_expressions.name} if set(rules) & set(judges_expressions.rules) else set()
    return judged | noted | {DECIDED_BY[rule].name for rule in rules if rule in DECIDED_BY}


def find_modules(experiments: Collection[str]) -> list[str]:
    """Return the names of the modules that define some experiments, and the parts of rules in them."""
    chosen = [EXPERIMENTS[name] for name in experiments if name in EXPERIMENTS]
    parts = {_MODULES[rule] for one in chosen for hook in one.hooks for rule in hook.rules}
    return sorted(parts | {one.run.__module__ for one in chosen})


def find_rules(experiments: Collection[str]) -> list[str]:
    """Return the ids of the rules that some experiments can say something about."""
    return [rule for rule in RULES if find_needs([rule]) & set(experiments)]


def choose_rules(select: Sequence[str] = (), ignore: Sequence[str] = ()) -> list[str]:
    """Return the ids of the rules that begin with one of `select` (all, if it is empty) and with none of `ignore`;
    raises `UsageError` if no rule begins with one of these, and if no rule is left."""
    selected, ignored = tuple(_codes(select, "--select") or FAMILIES), tuple(_codes(ignore, "--ignore"))
    rules = [rule for rule in RULES if rule.startswith(selected) and not rule.startswith(ignored)]
    if not rules:
        raise UsageError("--select and --ignore leave no rule; rlctl check-env --list shows all")
    return rules


def find_rule(code: str) -> Rule:
    """Return the rule with an id; raises `UsageError` with the closest."""
    if code.upper() in RULES:
        return RULES[code.upper()]
    family = [rule for rule in RULES if rule.startswith(code.upper())]
    hint = f" The family has: {', '.join(family)}." if family else did_you_mean(code.upper().replace("O", "0"), RULES)
    raise UsageError(f"no rule {code!r}.{hint} rlctl check-env --list shows all.")


def _codes(texts: Sequence[str], option: str) -> list[str]:
    codes = [code.strip().upper() for text in texts for code in text.split(",") if code.strip()]
    for code in codes:
        if not any(rule.startswith(code) for rule in RULES):
            closest = did_you_mean(code.replace("O", "0"), RULES) or did_you_mean(code, FAMILIES)
            raise UsageError(f"{option} {code}: no such rule.{closest} rlctl check-env --list shows all.")
    return codes
