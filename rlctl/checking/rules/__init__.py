'''The rules of check-env, a file each: text, severity, the code that judges it, and what that needs.

To add a rule, write `rl1xx_what_is_wrong.py` here, whose name begins with the id. No list has to name it.

    RULE = Rule("RL1xx", "what is wrong", Severity.WARNING, meaning="""...""", fix="""...""")

Its code is one of these, or several, but of each decorator one at most:

    @judges_records(RULE, "episodes")       # in the parent, from what experiments recorded; by default RECORDING
    def find_both_flags(records: Records) -> Iterator[RuleFinding]:
        yield RuleFinding(RULE, message, evidence)

    @judges_worlds(RULE)                    # its part of a shared experiment: a hook of `rlctl.checking.experiments`
    def find_no_gravity(watched: WatchedWorlds) -> Iterator[ChildMessage]: ...

    @experiment("rendering", INSTANCES, 100, RULE)    # of its own, in a child process: name, process, place in it
    def render(context: Context) -> Iterator[ChildMessage]: ...

`raise NotJudged(why)` or `NotApplicable(why)` ends a judge or an experiment, and applies to all its rules without a
finding; `yield Skipped(RULE.id, why)` in an experiment applies to one. An experiment calls the environment only through
`Instance.call`, `Instance.reset` and `EpisodePlayer`: its exceptions are then `EnvironmentRaised`, which need not be
caught, and hangs and crashes can be located. `context.budget` limits time and memory. An experiment that records
episodes yields what `Recording.run()` returns. A finding has its own severity or fix only if they differ.

Write a class that makes the mistake, `RL1xxSomeName`, and one that does not in `tests/checking/`, a `case` of both, and
then the rule's page: `python docs/make_rules.py --run RL1xx`.
'''

import importlib
import pkgutil
from collections.abc import Collection, Iterable, Sequence
from types import ModuleType
from typing import TypeVar

from rlctl.checking import experiments
from rlctl.checking.experiment import HASH_SEEDS, Experiment, RecordsJudge
from rlctl.checking.experiments.expressions import judges_expressions, note_expressions
from rlctl.checking.rule import Rule
from rlctl.errors import UsageError, did_you_mean

Value = TypeVar("Value")

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


def _import_modules(package: str, path: Sequence[str]) -> list[ModuleType]:
    return [importlib.import_module(f"{package}.{module.name}") for module in pkgutil.iter_modules(path)]


def _index(pairs: Iterable[tuple[str, Value]]) -> dict[str, Value]:
    """Return a dictionary; raises `ValueError` for what would be in it twice."""
    found: dict[str, Value] = {}
    for name, value in pairs:
        if found.setdefault(name, value) is not value:
            raise ValueError(f"{name}: two of {type(value).__name__}; one is enough")
    return found


_RULE_MODULES = _import_modules(__name__, __path__)
_MODULES = [
    *_RULE_MODULES,
    *_import_modules(experiments.__name__, experiments.__path__),
]
_MEMBERS = [value for module in _MODULES for value in vars(module).values()]
_EXPERIMENTS = _index((value.name, value) for value in _MEMBERS if isinstance(value, Experiment))

_RULES: list[Rule] = [module.RULE for module in _RULE_MODULES]
RULES = {rule.id: rule for rule in sorted(_RULES, key=lambda rule: rule.id)}
JUDGES = _index((value.rule, value) for value in _MEMBERS if isinstance(value, RecordsJudge))
EXPERIMENTS = {one.name: one for one in sorted(_EXPERIMENTS.values(), key=lambda one: one.place)}
DECIDED_BY = _index((rule, one) for one in EXPERIMENTS.values() for rule in one.rules)
PROCESSES = {
    process: tuple(one.name for one in EXPERIMENTS.values() if one.process == process) for process in HASH_SEEDS
}
"""The experiments of each child process, in their order."""


def find_needs(rules: Collection[str]) -> set[str]:
    """Return the names of the experiments that some rules need."""
    judged = {name for rule in rules if rule in JUDGES for name in JUDGES[rule].needs}
    noted = {note_expressions.name} if set(rules) & set(judges_expressions.rules) else set()
    return judged | noted | {DECIDED_BY[rule].name for rule in rules if rule in DECIDED_BY}


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
