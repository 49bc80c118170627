"""`rlctl check-env`, `rlctl tasks` and its commands, and `rlctl recipe`."""

import enum
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand

from rlctl.arguments import command, command_in_panels, parse_changes
from rlctl.errors import UsageError
from rlctl.options import Argument, Config, EnvTimeout, Json, Option, OptionalTask, Settings, SimOption, TaskName

if TYPE_CHECKING:
    from rlctl.environments.spec import EnvSpec

ReportFormat = enum.StrEnum("ReportFormat", ["text", "json", "sarif", "junit", "github"])


class CheckCommand(TyperCommand):
    """Reads `-o FILE` as the file of the `--format` before it; a format without a file goes to stdout."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert `-o -` where a format has no file, because Typer forgets the order of different options."""
        return super().parse_args(ctx, list(_fill_targets(args)))


def _fill_targets(arguments: Iterable[str]) -> Iterator[str]:
    is_waiting = False
    for argument in arguments:
        option = argument.partition("=")[0]
        if option == "--format":
            yield from ("-o", "-") if is_waiting else ()
            is_waiting = True
        elif option == "--output" or argument.startswith("-o"):
            is_waiting = False
        yield argument


@command_in_panels(
    {
        "Options": ["settings", "sim", "env_timeout", "budget"],
        "Rules": ["select", "ignore", "strict", "baseline"],
        "Output": ["form", "output", "json"],
        "Instead of a check": ["audit", "list_rules", "explain"],
    }
)
def check_env(
    task: OptionalTask = None,
    settings: Settings = [],
    sim: SimOption = None,
    select: Annotated[list[str], Option("Check only these rules: RL3,RL501.", metavar="RULES")] = [],
    ignore: Annotated[list[str], Option("Skip these rules: RL106.", metavar="RULES")] = [],
    strict: Annotated[
        bool, Option("Exit 1 for warnings, and for any rule without time to judge it.", ("--strict",))
    ] = False,
    form: Annotated[
        list[ReportFormat],
        Option(
            "Format of the report; of several, each but one with its -o FILE after it.",
            ("--format",),
            default_text="text",
        ),
    ] = [],
    output: Annotated[
        list[str],
        Option(
            "File of the report of the --format before it.", ("--output", "-o"), metavar="FILE", default_text="stdout"
        ),
    ] = [],
    json: Json = None,
    baseline: Annotated[
        str | None, Option("An earlier report of --json; its findings are not reported again.", metavar="FILE")
    ] = None,
    env_timeout: EnvTimeout = 10.0,
    budget: Annotated[
        float | None,
        Option(
            "Computing time in seconds of each process of the check.",
            min=1,
            default_text="18, and up to 90 for slow environments; of --audit 45",
        ),
    ] = None,
    audit: Annotated[
        bool, Option("Who earns most? Standing still, falling, ... play against what the task wants.", ("--audit",))
    ] = False,
    list_rules: Annotated[bool, Option("List all rules and exit.", ("--list",))] = False,
    explain: Annotated[
        str | None, Option("Explain a rule, or a finding of a training, such as Q10.", metavar="RULE")
    ] = None,
) -> None:
    """Find mistakes in an environment before hours of training are lost."""
    from rlctl import output as streams
    from rlctl.checking import formats
    from rlctl.checking.check import check
    from rlctl.checking.rule_index import choose_rules
    from rlctl.checking.tool_formats import read_baseline
    from rlctl.environments.suggestions import find_only_class
    from rlctl.recipe.recipe_files import make_spec

    if explain is not None and explain.upper().startswith("Q"):
        from rlctl.runs.diagnosis import findings

        streams.out().print("\n".join(findings.explain(explain)))
        return
    if list_rules or explain is not None:
        formats.show_list() if explain is None else formats.explain(explain)
        return
    if task is None:
        raise UsageError("give an environment to check, e.g. rlctl check-env reach; --list and --explain need none")
    if audit and (select or ignore or strict or form or output or baseline is not None):
        raise UsageError("--audit judges no rules: of the other options it takes --set, --sim, --json and the times")
    if json == "-" and (form or output):
        raise UsageError("--json - prints only JSON: leave out --format and -o, or give --json a file")
    targets = formats.pair_targets(form, output)
    known = set() if baseline is None else read_baseline(Path(baseline))
    if only := find_only_class(task):
        streams.print_notes([f"{task} has one environment class: {only}"])
        task = only
    spec = parse_changes(settings, sim).apply(make_spec(task))
    if audit:
        _audit(spec, env_timeout, budget, json)
    rules = choose_rules(select, ignore)
    report = check(spec, rules=rules, strict=strict, env_timeout_s=env_timeout, budget_s=budget)
    report.subtract(known)
    formats.show_crashes(report)
    formats.show_notes(report, [name for name, _ in targets])
    if json is not None:
        formats.show(report, "json", json)
    for name, target in targets if json != "-" else ():
        formats.show(report, name, target)
    raise typer.Exit(report.exit_code)


def _audit(spec: "EnvSpec", env_timeout: float, budget: float | None, json: str | None) -> NoReturn:
    from rlctl.checking.audit import report
    from rlctl.checking.audit.audit import audit

    result = audit(spec, env_timeout_s=env_timeout, budget_s=budget)
    report.show(result, json)
    raise typer.Exit(result.exit_code)


app = typer.Typer()


@app.callback(invoke_without_command=True)
@command
def tasks(
    context: typer.Context,
    check: Annotated[bool, Option("Import each task and command of plugins in a child process.", ("--check",))] = False,
    json: Json = None,
) -> None:
    """List the installed tasks; show one, or create your own."""
    if context.invoked_subcommand is not None:
        if check or json is not None:
            raise UsageError(f"put the options after `rlctl tasks {context.invoked_subcommand}`")
        return
    from rlctl.cli import plugin_commands
    from rlctl.tasks.listing import list_tasks, show

    show(list_tasks(check=check), plugin_commands.describe_all(check=check), json)


@app.command("show")
@command
def show_task(task: TaskName, json: Json = None) -> None:
    """Show a task's observations, actions, rewards, events, parameters and recipe."""
    from rlctl.tasks.description import describe
    from rlctl.tasks.show import show

    show(describe(task), json)


@app.command("new")
@command
def new_task(
    name: Annotated[str, Argument("Name of the task: letters, digits, - and _.", metavar="NAME")],
    model: Annotated[
        str | None, Option("Your robot: a URDF or MJCF file, copied with its meshes.", metavar="FILE")
    ] = None,
    link: Annotated[str | None, Option("Link, or site, of --model that is to reach the goal.", metavar="LINK")] = None,
    walk: Annotated[
        bool, Option("--model has legs and is free: a task in which it follows velocity commands.", ("--walk",))
    ] = False,
    pick: Annotated[
        bool, Option("--model is an arm with a gripper: a task in which it lifts a block to a goal.", ("--pick",))
    ] = False,
    place: Annotated[bool, Option("As --pick: it puts the block down at a goal.", ("--place",))] = False,
    push: Annotated[bool, Option("As --pick: it pushes the block to a goal.", ("--push",))] = False,
    gripper: Annotated[
        str | None, Option("Joint of the gripper of --pick, --place or --push, if it is not found.", metavar="JOINT")
    ] = None,
    tip: Annotated[
        str | None, Option("Link of --model whose origin is between the fingers, if it is not found.", metavar="FRAME")
    ] = None,
    motors: Annotated[
        str | None, Option("Real motors of --model by name, such as sts3215; MuJoCo only.", metavar="NAME")
    ] = None,
    backlash: Annotated[
        str | None, Option("Play of the gears of --motors, from end to end: 1deg or 0.02rad.", metavar="ANGLE")
    ] = None,
    motion: Annotated[
        list[str],
        Option("A clip for --model to follow, or to walk like with --walk; again for further ones.", metavar="FILE"),
    ] = [],
    rate: Annotated[
        float | None, Option("Frames per second of --motion, if they are not in the file.", min=1, metavar="HZ")
    ] = None,
    quaternion: Annotated[
        str | None, Option("Order of the root's quaternion in --motion: xyzw or wxyz.", metavar="ORDER")
    ] = None,
    clip_joints: Annotated[
        str | None,
        Option(
            "Joints of the columns of --motion, in their order; - for none, -NAME for the other sign.", metavar="NAMES"
        ),
    ] = None,
    frames: Annotated[
        str | None, Option("Frames of --motion that are taken, such as 120:480.", metavar="FIRST:LAST")
    ] = None,
    json: Json = None,
) -> None:
    """Create a starter plugin in a folder NAME: a reach, walk, pick or motion task, its recipe, tests."""
    from rlctl.task.clip_options import ClipOptions
    from rlctl.tasks.new import create, show

    hand = [name for name, asked in (("pick", pick), ("place", place), ("push", push)) if asked]
    names = tuple(part.strip() for part in (clip_joints or "").split(",") if part.strip())
    clip = ClipOptions(rate=rate, quaternion=quaternion, joints=names, frames=frames)
    plugin = create(
        name,
        model=model,
        link=link,
        walk=walk,
        hand=hand,
        gripper=gripper,
        tip=tip,
        motors=motors,
        backlash=backlash,
        motions=motion,
        clip=clip,
    )
    show(plugin, json)


@command
def recipe(
    task: OptionalTask = None,
    config: Config = None,
    algo: Annotated[str | None, Option("As with another algorithm.", completes="algorithm")] = None,
    settings: Settings = [],
    schema: Annotated[bool, Option("Print the JSON schema of recipes, for editors.", ("--schema",))] = False,
) -> None:
    """Print the complete recipe of a task, as rlctl train merges it, or the JSON schema of recipes."""
    from rlctl import output

    if schema:
        from rlctl.recipe.recipe import SCHEMA_FILE

        output.results().write(SCHEMA_FILE.read_text(encoding="utf-8"))
        return
    if task is None:
        raise UsageError("give a task, such as rlctl recipe reach, or --schema")
    from rlctl.recipe.sources import describe_other_algorithm, merge_flags, resolve_with_stages

    merged = merge_flags(settings, algo=algo)
    recipe = resolve_with_stages(task, config, merged)  # imports the task: a name that is no task has no recipe
    output.print_notes(describe_other_algorithm(task, config, merged))
    output.results().write(recipe.to_yaml())
