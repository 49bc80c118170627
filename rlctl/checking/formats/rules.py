"""What `--list` and `--explain` print."""

from __future__ import annotations

import textwrap

from rlctl import output
from rlctl.checking.finding import FAMILIES, RULES, Severity, find_rule
from rlctl.checking.formats.plain import STYLES


def show_list() -> None:
    """Print every rule, by family."""
    from rich.text import Text

    out = output.out()
    for family, title in FAMILIES.items():
        out.print(Text(f"{family} {title}", "bold"))
        for rule in RULES.values():
            if rule.id.startswith(family):
                severity = Text(f"{rule.severity:<8}", STYLES[rule.severity])
                out.print(Text(f"  {rule.id}  ").append_text(severity).append(rule.name))
    counts = ", ".join(
        f"{sum(rule.severity is severity for rule in RULES.values())} {severity}s" for severity in Severity
    )
    out.print(f"{len(RULES)} rules: {counts}. rlctl check-env --explain {next(iter(RULES))} says more.")


def explain(code: str) -> None:
    """Print what a rule means, and what to do about it."""
    from rich.text import Text

    out, rule = output.out(), find_rule(code)
    out.print(Text(f"{rule.id}  {rule.name}", "bold"))
    out.print(Text(f"{rule.severity}, {FAMILIES[rule.id[:3]]}", STYLES[rule.severity]))
    for paragraph in rule.meaning.split("\n\n"):
        out.print("\n" + textwrap.fill(" ".join(paragraph.split()), 100))
    out.print(f"\nfix: {textwrap.fill(rule.fix, 100)}")
    out.print(f'waive: rlctl_ignore = {{"{rule.id}": "why this is meant"}} on the class', style="dim")
