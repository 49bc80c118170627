"""What there is to find: `--list`, `--explain`, and the page of the documentation.

`python -m rlctl.checking.formats.rules > docs/rules.md` writes the page.
"""

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


_PAGE = """# The rules of check-env

`rlctl check-env TASK` builds an environment in child processes, plays a few dozen episodes, and judges what comes back
by these {count} rules. An **error** makes training wrong or impossible (exit code 1), a **warning** is likely wrong
(exit code 1 with `--strict`), an **info** is worth knowing. A finding may be milder than its rule, as the text says.

`--select RL3,RL501` judges only some, `--ignore RL107` all but some, `--explain RL304` shows one. What is meant can be
waived on the environment's class, with the reason: `rlctl_ignore = {{"RL604": "the fall is the goal"}}`.

This page is generated: `python -m rlctl.checking.formats.rules > docs/rules.md`.
"""


def render_page() -> str:
    """Return every rule as Markdown, by family."""
    parts = [_PAGE.format(count=len(RULES))]
    for family, title in FAMILIES.items():
        parts.append(f"## {family}: {title}\n")
        for rule in RULES.values():
            if rule.id.startswith(family):
                text = f"### {rule.id} {rule.name}\n\n**{rule.severity}.** {rule.meaning}\n\n*Fix:* {rule.fix}\n"
                parts.append(text)
    return "\n".join(parts)
