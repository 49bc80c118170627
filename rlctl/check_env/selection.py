"""From `--select RL3,RL501` and `--ignore RL106` to rules."""

from __future__ import annotations

from collections.abc import Sequence

from rlctl.check_env.finding import FAMILIES, RULES, Rule
from rlctl.errors import UsageError, did_you_mean


def choose_rules(select: Sequence[str] = (), ignore: Sequence[str] = ()) -> list[str]:
    """Return the ids of the rules that begin with one of `select` (all, if it is empty) and with none of `ignore`.

    Raises `UsageError` for what no rule's id begins with, and where nothing is left.
    """
    selected, ignored = _codes(select, "--select"), _codes(ignore, "--ignore")
    rules = [rule for rule in RULES if rule.startswith(tuple(selected or FAMILIES))]
    rules = [rule for rule in rules if not rule.startswith(tuple(ignored))]
    if not rules:
        raise UsageError("--select and --ignore leave no rule; rlctl check-env --list shows all")
    return rules


def find_rule(code: str) -> Rule:
    """Return the rule with an id or a name; raises `UsageError` with the closest."""
    for rule in RULES.values():
        if code.upper() == rule.id or code == rule.name:
            return rule
    family = [rule for rule in RULES if rule.startswith(code.upper())]
    hint = f" The family has: {', '.join(family)}." if family else did_you_mean(code.upper(), RULES)
    raise UsageError(f"no rule {code!r}.{hint} rlctl check-env --list shows all.")


def _codes(texts: Sequence[str], option: str) -> list[str]:
    codes = [code.strip().upper() for text in texts for code in text.split(",") if code.strip()]
    for code in codes:
        if not any(rule.startswith(code) for rule in RULES):
            closest = did_you_mean(code, [*FAMILIES, *RULES])
            raise UsageError(f"{option} {code}: no such rule.{closest} rlctl check-env --list shows all.")
    return codes
