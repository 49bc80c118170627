"""`rlctl check-env`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from rlctl.cli.arguments import command, parse_changes
from rlctl.errors import UsageError
from rlctl.options import EnvTimeout, Json, Option, OptionalTask, Settings


@command
def check_env(
    task: OptionalTask = None,
    settings: Settings = [],
    select: Annotated[list[str], Option("Check only these rules: RL3,RL501.", metavar="RULES")] = [],
    ignore: Annotated[list[str], Option("Skip these rules: RL106.", metavar="RULES")] = [],
    strict: Annotated[bool, Option("Exit 1 for warnings too.", ("--strict",))] = False,
    form: Annotated[
        Literal["text", "json", "sarif", "github"] | None,
        Option("Format of the report.", ("--format",), default_text="text"),
    ] = None,
    output: Annotated[
        str | None, Option("File of the report.", ("--output", "-o"), metavar="FILE", default_text="stdout")
    ] = None,
    json: Json = None,
    baseline: Annotated[
        str | None, Option("An earlier report of --json; its findings are not reported again.", metavar="FILE")
    ] = None,
    env_timeout: EnvTimeout = 10.0,
    list_rules: Annotated[bool, Option("List all rules and exit.", ("--list",))] = False,
    explain: Annotated[
        str | None, Option("Explain a rule, or a finding of a training, such as Q10.", metavar="RULE")
    ] = None,
) -> None:
    """Find mistakes in an environment before hours of training are lost."""
    from rlctl.checking import formats
    from rlctl.checking.check import check
    from rlctl.checking.rules import choose_rules
    from rlctl.checking.tool_formats import read_baseline
    from rlctl.environments.spec import EnvSpec

    if explain is not None and explain.upper().startswith("Q"):
        from rlctl import output as streams
        from rlctl.runs.diagnosis import findings

        streams.out().print("\n".join(findings.explain(explain)))
        return
    if list_rules or explain is not None:
        formats.show_list() if explain is None else formats.explain(explain)
        return
    if task is None:
        raise UsageError("give an environment to check, e.g. rlctl check-env reach; --list and --explain need none")
    if json == "-" and (form or output):
        raise UsageError("--json - prints only JSON: leave out --format and -o, or give --json a file")
    known = set() if baseline is None else read_baseline(Path(baseline))
    spec = parse_changes(settings).apply(EnvSpec(task))
    report = check(spec, rules=choose_rules(select, ignore), strict=strict, env_timeout_s=env_timeout)
    report.subtract(known)
    formats.show_crashes(report)
    if json is not None:
        formats.show(report, "json", json)
    if json != "-":
        formats.show(report, form or "text", output)
    raise typer.Exit(report.exit_code)
