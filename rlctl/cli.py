"""The command line: parse, call one function, print. What a verb needs is imported inside its command."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer
from typer.core import TyperGroup

from rlctl import __version__, completion, error_boundary
from rlctl.errors import RlctlError, UsageError

if TYPE_CHECKING:
    from rlctl.env_spec import EnvChanges

app = typer.Typer(
    name="rlctl",
    help="Robot learning in simulation, end to end: check an environment, train, evaluate, export, replay.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={
        "help_option_names": ["-h", "--help"],
        # Typer hands over names without their dashes in front.
        "token_normalize_func": lambda name: {"num-envs": "n-envs"}.get(name.replace("_", "-"), name.replace("_", "-")),
    },
)

tasks_app = typer.Typer()
app.add_typer(tasks_app, name="tasks")


class _RunsGroup(TyperGroup):
    """Reads `rlctl runs [TASK]` as `rlctl runs list [TASK]`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or (args[0] not in self.commands and args[0] not in ctx.help_option_names):
            args = ["list", *args]
        return super().parse_args(ctx, args)


runs_app = typer.Typer(cls=_RunsGroup, help="List runs, show one, compare several, remove what is not needed.")
app.add_typer(runs_app, name="runs")

TASK_FORMS = "Installed name, package.module:Class, path/to/file.py:Class, or Gymnasium id."
OptionalTask = Annotated[
    Optional[str],  # noqa: UP045
    typer.Argument(
        metavar="TASK",
        help=TASK_FORMS,
        show_default=False,
        autocompletion=completion.complete_task,
    ),
]
Run = Annotated[
    Optional[str],  # noqa: UP045 (Typer evaluates it)
    typer.Argument(
        help="Run folder, policy file, task name, or latest.",
        show_default="latest",
        autocompletion=completion.complete_run,
    ),
]
Set = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Set a key, e.g. task.tolerance=0.02, randomize=true.",
        show_default=False,
    ),
]
Json = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--json", metavar="FILE", help="Write the result as JSON; - for stdout.", show_default=False),
]
Seed = Annotated[Optional[int], typer.Option(help="Seed.", min=0)]  # noqa: UP045
EnvTimeout = Annotated[float, typer.Option(metavar="SECONDS", help="How long a step or reset may take.", min=0.1)]
NEnvs = Annotated[Optional[int], typer.Option(help="Environments stepped side by side.", min=1, show_default=False)]  # noqa: UP045
Checkpoint = Annotated[str, typer.Option(metavar="best|last|STEP", help="Which policy of the run.")]


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"rlctl {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    pass


@app.command("check-env")
def check_env(
    task: OptionalTask = None,
    settings: Set = [],  # noqa: B006 (Typer copies it)
    select: Annotated[
        list[str],
        typer.Option(metavar="RULES", help="Judge only these: RL3,RL501.", show_default=False),
    ] = [],  # noqa: B006
    ignore: Annotated[
        list[str], typer.Option(metavar="RULES", help="Leave these out: RL106.", show_default=False)
    ] = [],  # noqa: B006
    strict: Annotated[bool, typer.Option("--strict", help="Exit 1 for warnings too.")] = False,
    form: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--format", metavar="text|json|sarif|github", help="Form of the report.", show_default="text"),
    ] = None,
    output: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--output", "-o", metavar="FILE", help="Where the report goes.", show_default="stdout"),
    ] = None,
    json: Json = None,
    env_timeout: EnvTimeout = 10.0,
    list_rules: Annotated[bool, typer.Option("--list", help="List all rules, and do nothing else.")] = False,
    explain: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(metavar="RULE", help="Say what a rule means, and do nothing else.", show_default=False),
    ] = None,
) -> None:
    """Find what is wrong with an environment before hours of training do."""
    _claim_stdout()
    from rlctl.check_env import formats
    from rlctl.check_env.check import check
    from rlctl.check_env.formats import rules
    from rlctl.check_env.selection import choose_rules
    from rlctl.env_spec import EnvSpec

    if list_rules or explain is not None:
        rules.show_list() if explain is None else rules.explain(explain)
        return
    if task is None:
        raise UsageError("give an environment to check, e.g. rlctl check-env reach; --list and --explain need none")
    form, target = formats.choose(form, output, json)
    spec = _parse_changes(settings).apply(EnvSpec(task))
    report = check(spec, rules=choose_rules(select, ignore), strict=strict, env_timeout_s=env_timeout)
    formats.show(report, form, target)
    raise typer.Exit(report.exit_code)


@app.command()
def train(
    task: OptionalTask = None,
    resume: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            metavar="RUN",
            help="Go on with a run instead: a folder, a task's name, or latest.",
            show_default=False,
            autocompletion=completion.complete_run,
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Go on with a run even if its task has changed.")] = False,
    config: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(metavar="FILE", help="Recipe that goes over the task's own, or presets/NAME.", show_default=False),
    ] = None,
    settings: Set = [],  # noqa: B006
    algo: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="ppo, a2c, sac, td3, ddpg, dqn, tqc, crossq or recurrent_ppo.",
            show_default=False,
            autocompletion=completion.complete_algorithm,
        ),
    ] = None,
    seed: Annotated[Optional[int], typer.Option(help="Seed of everything random.", show_default=False)] = None,  # noqa: UP045
    total_timesteps: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--total-timesteps", "-n", metavar="STEPS", help="Environment steps; 1e6 is fine.", show_default=False
        ),
    ] = None,
    n_envs: NEnvs = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, or auto.")] = "cpu",
    stop_success: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(
            metavar="RATE", help="Stop after two evaluations in a row at this success rate.", show_default=False
        ),
    ] = None,
    record: Annotated[int, typer.Option(metavar="N", help="Write the last N evaluation episodes as .rrd.", min=0)] = 0,
    no_check: Annotated[bool, typer.Option("--no-check", help="Train without checking the environment first.")] = False,
    env_timeout: EnvTimeout = 60.0,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where run folders go.")] = Path(
        "runs"
    ),
    json: Json = None,
) -> None:
    """Train a policy, evaluate as it goes, and keep the best and the last."""
    _claim_stdout()
    from rlctl.run.recipe import merge_flags
    from rlctl.train.request import TrainRequest, run_training
    from rlctl.train.summary import show

    request = TrainRequest(
        task=task,
        resume=resume,
        config=config,
        settings=merge_flags(
            settings, algo=algo, seed=seed, total_timesteps=total_timesteps, n_envs=n_envs, stop_success=stop_success
        ),
        device=device,
        record=record,
        env_timeout_s=env_timeout,
        root=output,
        check=not no_check,
        force=force,
    )
    show(run_training(request), json)


@app.command("eval")
def evaluate(
    run: Run = None,
    task: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Evaluate on this task instead of the one it was trained on.", show_default=False),
    ] = None,
    checkpoint: Checkpoint = "best",
    episodes: Annotated[int, typer.Option("--episodes", help="Episodes, each with its own seed.", min=1)] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the list of episodes.", min=0)] = 0,
    stage: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(metavar="N|all", help="Stage of the curriculum it was trained in.", show_default="the last"),
    ] = None,
    settings: Set = [],  # noqa: B006
    stochastic: Annotated[
        bool, typer.Option("--stochastic", help="Sample actions instead of taking the mean.")
    ] = False,
    n_envs: NEnvs = None,
    min_success: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(metavar="RATE", help="Gate: exit 1 below this success rate.", show_default=False),
    ] = None,
    min_success_lower: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(metavar="RATE", help="Gate on the lower bound of the 95 % interval.", show_default=False),
    ] = None,
    min_return: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(metavar="RETURN", help="Gate: exit 1 below this mean return.", show_default=False),
    ] = None,
    env_timeout: EnvTimeout = 60.0,
    json: Json = None,
) -> None:
    """Say how good a policy is: success rate with its interval, returns, reward terms."""
    _claim_stdout()
    from rlctl.eval.evaluate import EvalRequest, Gates, run_evaluations
    from rlctl.eval.report import show_all

    gates = Gates(min_success, min_success_lower, min_return)
    results = run_evaluations(
        EvalRequest(
            run=run,
            task=task,
            checkpoint=checkpoint,
            episodes=episodes,
            seed=seed,
            changes=_parse_changes(settings),
            stage=stage,
            deterministic=not stochastic,
            n_envs=n_envs,
            env_timeout_s=env_timeout,
        ),
        gates,
    )
    show_all(results, json)
    gates.check(*results)


@app.command()
def export(
    run: Run = None,
    onnx: Annotated[bool, typer.Option("--onnx", help="Write an ONNX file: the only format, so not needed.")] = True,
    checkpoint: Checkpoint = "best",
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            "--output", "-o", metavar="FILE", help="Default: exports/policy.onnx of the run.", show_default=False
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Turn a policy into a self-contained ONNX file, and verify that it acts the same."""
    _claim_stdout()
    from rlctl.export.export import export_onnx
    from rlctl.export.report import show

    show(export_onnx(run, checkpoint=checkpoint, output=output), json)


@app.command()
def replay(
    source: Annotated[
        Optional[str],  # noqa: UP045
        typer.Argument(
            metavar="[RUN or EPISODE]",
            help="A run or policy to roll out, or a recorded episode (.npz).",
            show_default="latest",
            autocompletion=completion.complete_run,
        ),
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", help="Episodes to roll out.", min=1)] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the list of episodes.", min=0)] = 0,
    checkpoint: Checkpoint = "best",
    task: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Roll out on this task instead of the one it was trained on.", show_default=False),
    ] = None,
    settings: Set = [],  # noqa: B006
    verify: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(metavar="EPISODE", help="Replay a recorded episode; exit 1 unless identical.", show_default=False),
    ] = None,
    gui: Annotated[bool, typer.Option("--gui", help="Show it in PyBullet's window instead of recording.")] = False,
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="An .rrd file or a folder. Default: episodes/ of the run.",
            show_default=False,
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Show what a policy does: rollouts as Rerun recordings, without a display."""
    _claim_stdout()
    from rlctl.replay.replay import ReplayRequest, run_replay
    from rlctl.replay.report import show

    result = run_replay(
        ReplayRequest(
            source=source,
            episodes=episodes,
            seed=seed,
            checkpoint=checkpoint,
            task=task,
            changes=_parse_changes(settings),
            verify=verify,
            gui=gui,
            output=output,
        )
    )
    show(result, json)
    result.check()


@tasks_app.callback(invoke_without_command=True)
def tasks(
    context: typer.Context,
    check: Annotated[bool, typer.Option("--check", help="Import each task, in a process of its own.")] = False,
    json: Json = None,
) -> None:
    """List the installed tasks; show one of them, or begin one of your own."""
    if context.invoked_subcommand is not None:
        if check or json is not None:
            raise UsageError(f"options of `rlctl tasks {context.invoked_subcommand}` come after its name")
        return
    from rlctl.tasks.listing import list_tasks, show

    show(list_tasks(check=check), json)


@tasks_app.command("show")
def show_task(
    task: Annotated[
        str,
        typer.Argument(metavar="TASK", help=TASK_FORMS, show_default=False, autocompletion=completion.complete_task),
    ],
    json: Json = None,
) -> None:
    """Show what a task observes, does and rewards, what can be set, and how it is trained."""
    _claim_stdout()
    from rlctl.tasks.description import describe
    from rlctl.tasks.show import show

    show(describe(task), json)


@tasks_app.command("new")
def new_task(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the task: letters, digits, - and _.")],
    json: Json = None,
) -> None:
    """Write a plugin to begin with, in a folder of its name: a task that learns at once, its recipe and tests."""
    from rlctl.tasks.new import create, show

    show(create(name), json)


@runs_app.command("list")
def list_runs(
    task: Annotated[
        Optional[str],  # noqa: UP045
        typer.Argument(metavar="[TASK]", help="Only the runs of this task.", show_default=False),
    ] = None,
    sort: Annotated[str, typer.Option(metavar="newest|score|steps|minutes", help="Order.")] = "newest",
    json: Json = None,
) -> None:
    """List every run below ./runs. `rlctl runs` alone does the same."""
    from rlctl.runs.listing import list_runs, show

    show(list_runs(task, sort=sort), json)


@runs_app.command("show")
def show_run(run: Run = None, json: Json = None) -> None:
    """Show a run: its recipe, curve, evaluations, warnings and files."""
    from rlctl.runs.show import describe, show

    show(describe(run), json)


@runs_app.command("compare")
def compare_runs(
    runs: Annotated[
        list[str],
        typer.Argument(metavar="A B...", help="Runs, globs or folders of runs; the first is the baseline."),
    ],
    episodes: Annotated[int, typer.Option("--episodes", help="Episodes that each run plays.", min=2)] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the list of episodes.", min=0)] = 0,
    task: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Evaluate all on this task.", show_default=False),
    ] = None,
    threshold: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(help="Success rate (or return) to be reached soon; 0.9 where success is known."),
    ] = None,
    gate: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(metavar="not-worse", help="Exit 1 if one is worse than the first.", show_default=False),
    ] = None,
    json: Json = None,
) -> None:
    """Say whether a policy, or a recipe trained with several seeds, is better than another."""
    _claim_stdout()
    if gate not in (None, "not-worse"):
        raise UsageError(f"--gate {gate}: the one gate there is is not-worse")
    from rlctl.runs.comparison import CompareRequest, compare
    from rlctl.runs.comparison_report import show

    result = compare(CompareRequest(runs, episodes, seed, task, threshold))
    show(result, json)
    if gate:
        result.check()


@runs_app.command("import")
def import_run(
    model: Annotated[Path, typer.Argument(metavar="MODEL.zip", help="Model of Stable-Baselines3 or rl-zoo3.")],
    task: Annotated[str, typer.Option(metavar="TASK", help=f"What it was trained on. {TASK_FORMS}")],
    vecnormalize: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(metavar="FILE.pkl", help="Its normalisation, if it has one.", show_default=False),
    ] = None,
    algo: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Its algorithm, where the file does not tell it.", show_default=False),
    ] = None,
    settings: Set = [],  # noqa: B006
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--output", "-o", metavar="FILE", help="Policy file to write. Default: MODEL.safetensors."),
    ] = None,
    json: Json = None,
) -> None:
    """Turn a model of Stable-Baselines3 into a policy file. Nothing in the model is unpickled."""
    _claim_stdout()
    from rlctl.runs.import_model import ImportRequest, import_model, show

    request = ImportRequest(model, task, vecnormalize, algo, output, _parse_changes(settings))
    show(import_model(request), json)


@runs_app.command("rm")
def remove_runs(
    runs: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Argument(metavar="RUN...", help="Folders of runs.", show_default=False),
    ] = None,
    keep_best: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(metavar="N", help="Remove all finished or failed runs but the N best of each task.", min=0),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Remove runs, never one that is being trained."""
    from rlctl.runs.removal import plan_removal, remove_with_report

    remove_with_report(plan_removal(runs or [], keep_best=keep_best), yes=yes)


@runs_app.command("prune")
def prune_runs(yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False) -> None:
    """Remove the checkpoints of finished runs, which are needed only to train on."""
    from rlctl.runs.removal import plan_prune, remove_with_report

    remove_with_report(plan_prune(), yes=yes)


def _claim_stdout() -> None:
    """Keep stdout for the result: what a plugin prints from now on goes to stderr."""
    from rlctl import output

    output.results()


def _parse_changes(settings: list[str]) -> EnvChanges:
    from rlctl.run.recipe import parse_changes

    return parse_changes(settings)


def main() -> None:
    """Run the command line and end the process with its exit code."""
    error_boundary.prepare_streams()
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run a command line; return the exit code: the one error boundary."""
    try:
        code = app(arguments, standalone_mode=False)
        error_boundary.flush()
        return code if isinstance(code, int) else 0
    except RlctlError as error:
        return error_boundary.report(error)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        error_boundary.close_stdout()
        return 141
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):  # what Typer and Rich make of it
            error_boundary.close_stdout()
            return 141
        raise
    except Exception as error:
        return error_boundary.report_unexpected(error)
