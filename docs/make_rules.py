"""Writes docs/rules.md and a page for each rule of check-env, from their texts and the twins that the tests run.

`python docs/make_rules.py` writes all pages and keeps what rlctl printed; with `--run` it checks the broken twins again
(minutes), with `--run RL405 RL108` those of some rules. Run it in the root of the repository.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rlctl.checking.check import check
from rlctl.checking.rule import Rule
from rlctl.checking.rule_index import FAMILIES, RULES
from rlctl.environments.spec import EnvSpec

ROOT = Path(__file__).parent.parent
TESTS = ROOT / "tests" / "checking"
PAGES = ROOT / "docs" / "rules"
MOST_LINES = 14
FENCE = "```"

INDEX = """# The rules of check-env

`rlctl check-env TASK` builds an environment in child processes, plays a few dozen episodes, and checks the results with
these {count} rules. An **error** makes training wrong or impossible (exit code 1), a **warning** is likely wrong
(exit code 1 with `--strict`), an **info** is worth knowing. The text of a rule says when its findings are less severe.
A check that had no time for a quarter or more of the rules is no pass (exit code 1); its last line says which
`--budget` should be enough.

In some episodes it also notes what each expression of the environment's own source is worth, by copies of the
functions' code, and lets conditions be true that rarely are. What is computed wrongly then shows also where it is not
observed, and the finding names the line. The environment's files stay as they are.

`--select RL3,RL501` checks only these rules, `--ignore RL106` skips a rule, `--explain RL304` prints one. If a finding
is intended, waive its rule in the environment's class, with the reason:
`rlctl_ignore = {{"RL604": "the fall is the goal"}}`. In a pull request, `--baseline FILE` reports only new findings; an
earlier check with `--json FILE` writes the file.

This page is generated: `python docs/make_rules.py`.
"""


def render_all(printed: dict[str, str]) -> dict[Path, str]:
    """Return the text of every page by its path; `printed` is what rlctl says of the mistake, by rule."""
    cases = _find_cases()
    pages = {ROOT / "docs" / "rules.md": _render_index()}
    for rule in RULES.values():
        pages[PAGES / f"{rule.id}.md"] = _render_page(rule, cases.get(rule.id), printed.get(rule.id, ""))
    return pages


def read_printed() -> dict[str, str]:
    """Return what the pages that are there say that rlctl prints, by rule."""
    pattern = re.compile(rf"rlctl prints:\n\n{FENCE}text\n(.*?){FENCE}", re.DOTALL)
    texts = {file.stem: pattern.search(file.read_text(encoding="utf-8")) for file in PAGES.glob("RL*.md")}
    return {rule: match[1] for rule, match in texts.items() if match}


def run_cases(rules: Sequence[str]) -> dict[str, str]:
    """Check the broken twins of some rules, or of all, and return what rlctl prints of them."""
    from tests.checking.judging import IN_PROCESSES, verdict_of

    printed = {}
    for rule, case in _find_cases().items():
        if rules and rule not in rules:
            continue
        if case in IN_PROCESSES:
            verdict = check(EnvSpec(f"{TESTS}/{case.broken}"), env_timeout_s=2.0, rules=[rule]).verdict
        else:
            verdict = verdict_of(case.broken, *case.rules)
        for finding in verdict.findings:
            if finding.rule == rule and rule not in printed:
                lines = [f"{finding.severity} {rule}  {finding.name}", f"  {finding.message}"]
                text = "\n".join(lines).replace(f"{TESTS}/", "").replace(f"{TESTS.relative_to(ROOT)}/", "")
                printed[rule] = text.replace(str(Path.cwd()), "FOLDER") + "\n"
    return printed


def _find_cases() -> dict[str, Any]:
    """Return one case per rule: the first whose broken class has the rule's code in its name."""
    from tests.checking.judging import list_cases

    cases: dict[str, Any] = {}
    for case in list_cases():
        for rule in case.codes:
            cases.setdefault(rule, case)
    return cases


def _render_index() -> str:
    parts = [INDEX.format(count=len(RULES))]
    for family, title in FAMILIES.items():
        parts.append(f"## {family}: {title}\n")
        for rule in RULES.values():
            if rule.id.startswith(family):
                text = f"### [{rule.id}](rules/{rule.id}.md) {rule.name}\n\n**{rule.severity}.** {rule.meaning}\n"
                parts.append(f"{text}\n*Fix:* {rule.fix}\n")
    return "\n".join(parts)


def _render_page(rule: Rule, case: Any, printed: str) -> str:
    parts = [f"# {rule.id}: {rule.name}\n", f"**{rule.severity}**, {FAMILIES[rule.id[:3]]}. {rule.meaning}\n"]
    if case is not None:
        broken, sound = _find_class(case.broken), _find_class(case.twin)
        source = _read_source(broken) or (TESTS / case.broken.partition(":")[0]).read_text()
        wrong, right = _shorten(source), _find_counterpart(broken, sound)
        parts.append(f"The mistake:\n\n{FENCE}python\n{wrong}{FENCE}\n")
        if printed:
            parts.append(f"rlctl prints:\n\n{FENCE}text\n{printed}{FENCE}\n")
        if right:
            parts.append(f"Without the mistake:\n\n{FENCE}python\n{right}{FENCE}\n")
    parts.append(f"**What to do.** {rule.fix}\n")
    if rule.task_fix != rule.fix:
        parts.append(f"**In a task of rlctl.** {rule.task_fix}\n")
    parts.append("[All rules](../rules.md)\n")
    return "\n".join(parts)


def _find_class(task: str) -> Any:
    file, _, name = task.partition(":")
    sys.path.insert(0, str(TESTS))
    try:
        return getattr(importlib.import_module(file.removesuffix(".py")), name, None)
    except Exception:  # a twin that cannot be imported is the mistake
        return None
    finally:
        sys.path.remove(str(TESTS))


def _read_source(cls: Any) -> str:
    try:
        return inspect.getsource(cls)
    except (OSError, TypeError):  # it cannot be imported, or is made by a function
        return ""


def _find_counterpart(broken: Any, sound: Any) -> str:
    """Return how the sound twin defines what the broken one defines."""
    if not inspect.isclass(broken) or not inspect.isclass(sound):
        return ""
    if issubclass(sound, broken):
        return _shorten(_read_source(sound))
    texts = []
    for name in vars(broken):
        value = inspect.getattr_static(sound, name, None)
        if inspect.isfunction(value) and name != "__init__":
            texts.append(textwrap.indent(textwrap.dedent(_read_source(value)), "    "))
    return f"class {sound.__name__}:\n{_shorten(chr(10).join(texts))}" if texts else _shorten(_read_source(sound))


def _shorten(source: str) -> str:
    """Leave out docstrings and what comes after enough lines."""
    source = re.sub(r'^ *""".*?"""\n+', "", source, flags=re.DOTALL | re.MULTILINE)
    lines = source.rstrip().splitlines()
    more = ["", "    ..."] if len(lines) > MOST_LINES else []
    text = "\n".join(lines[:MOST_LINES]).rstrip()
    return "\n".join([text, *more]) + "\n"


def main() -> None:
    """Write the pages."""
    printed = read_printed()
    if "--run" in sys.argv:
        printed |= run_cases(sys.argv[2:])
    PAGES.mkdir(exist_ok=True)
    for file, text in render_all(printed).items():
        file.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main()
