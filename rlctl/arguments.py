"""From the fields of requests to options of Typer, what the shell completes, and options that commands share."""

from __future__ import annotations

import dataclasses
import inspect
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlctl import output
from rlctl.library_output import redirect_stdout
from rlctl.options import Argument, Option
from rlctl.printed_lines import collect

if TYPE_CHECKING:
    from rlctl.engine import Engine
    from rlctl.environments.spec import EnvChanges

ALGORITHMS = ("ppo", "a2c", "sac", "td3", "ddpg", "dqn", "tqc", "crossq", "xqc", "recurrent_ppo")
"""Those of recipes, without the time that it takes to import their models."""
_RUNS = Path("runs")
_MOST = 50


def complete_task(incomplete: str) -> list[str]:
    """Return the installed tasks and the Python files here that begin with `incomplete`."""
    from rlctl.environments import installed  # here, because the help of every command imports this module

    names = [entry.name for entry in installed.list_installed() if entry.problem is None]
    return [name for name in (*dict.fromkeys(names), *_list_paths(incomplete, "*.py")) if name.startswith(incomplete)]


def complete_algorithm(incomplete: str) -> list[str]:
    """Return the algorithms that begin with `incomplete`."""
    return [name for name in ALGORITHMS if name.startswith(incomplete)]


def complete_run(incomplete: str) -> list[str]:
    """Return `latest`, tasks with runs, runs (newest first) and policy files here that begin with `incomplete`."""
    runs = sorted((file.parent for file in _RUNS.glob("*/*/run.json")), key=lambda run: run.name, reverse=True)
    tasks = dict.fromkeys(run.parent.name for run in runs)
    latest = ["latest"] if runs else []
    files = [*_list_paths(incomplete, "*.safetensors"), *_list_paths(incomplete, "*.onnx")]
    candidates = [*latest, *tasks, *(str(run) for run in runs[:_MOST]), *files]
    return [text for text in candidates if text.startswith(incomplete)]


def _list_paths(incomplete: str, pattern: str) -> list[str]:
    folder = Path(incomplete).parent if "/" in incomplete else Path()
    return [str(path) for path in sorted(folder.glob(pattern))[:_MOST]]


_COMPLETIONS = {"task": complete_task, "run": complete_run, "algorithm": complete_algorithm}


Panels = Mapping[str, Sequence[str]]
"""Title of a panel of the help -> names of the parameters in it. Typer puts --help into `Options`, the first one."""


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function for Typer: the option fields of a dataclass parameter replace the parameter."""
    return _make_command(function, {})


def command_in_panels(panels: Panels) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator as `command`, whose help shows the options in panels, in this order."""
    return lambda function: _make_command(function, panels)


def _make_command(function: Callable[..., None], panels: Panels) -> Callable[..., None]:
    parameters, requests = [], {}
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        if not dataclasses.is_dataclass(parameter.annotation):
            parameters.append(_make_parameter(parameter.name, parameter.annotation, parameter.default))
            continue
        request: Any = parameter.annotation
        hints = typing.get_type_hints(request, include_extras=True)
        fields = [field for field in dataclasses.fields(request) if _find_option(hints[field.name])]
        parameters += [_make_parameter(field.name, hints[field.name], _find_default(field)) for field in fields]
        requests[parameter.name] = (request, [field.name for field in fields])
    parameters = _arrange(parameters, panels)
    turned_off = [parameter.name for parameter in parameters if _turns_off(parameter.annotation)]

    def run(**values: Any) -> None:
        output.results()  # reserves stdout for the result: plugins print to stderr from now on
        values |= {name: not values[name] for name in turned_off}
        for name, (request, fields) in requests.items():
            values[name] = request(**{field: values.pop(field) for field in fields})
        with collect(), redirect_stdout():
            return function(**values)

    run.__name__, run.__doc__ = function.__name__, function.__doc__
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _arrange(parameters: list[inspect.Parameter], panels: Panels) -> list[inspect.Parameter]:
    """Return arguments first, then options in the order of the panels, each with the title of its own."""
    titles = {name: title for title, names in panels.items() for name in names}
    for parameter in parameters:
        if parameter.name in titles:
            parameter.annotation.__metadata__[0].rich_help_panel = titles[parameter.name]
    order = [parameter.name for parameter in parameters if parameter.name not in titles] + list(titles)
    return sorted(parameters, key=lambda parameter: order.index(parameter.name))


def _find_option(annotation: Any) -> Option | None:
    return next((data for data in getattr(annotation, "__metadata__", ()) if isinstance(data, Option)), None)


def _turns_off(annotation: Any) -> bool:
    """Return whether an option is a flag such as `--no-check`, which makes its field False."""
    option = _find_option(annotation)
    return option is not None and any(flag.startswith("/") for flag in option.flags)


def _find_default(field: dataclasses.Field[Any]) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _make_parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    if (option := _find_option(annotation)) is not None:
        kind = annotation.__origin__
        default = False if _turns_off(annotation) else default
        make = typer.Argument if isinstance(option, Argument) else typer.Option
        made: Any = make(
            *(flag.removeprefix("/") for flag in option.flags),
            help=option.help,
            metavar=option.metavar,
            min=option.min,
            max=option.max,
            autocompletion=None if option.completes is None else _COMPLETIONS[option.completes],
            show_default=option.default_text or kind is not bool,
            parser=option.parse,
        )
        annotation = Annotated[kind, made, option]
    default = inspect.Parameter.empty if default is dataclasses.MISSING else default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def choose_checkpoint(checkpoint: str, pretrained: bool) -> str:
    """Return the requested policy, from `--checkpoint` or `--pretrained`."""
    if not pretrained:
        return checkpoint
    from rlctl.errors import UsageError
    from rlctl.policy.shipped import PRETRAINED

    if checkpoint not in ("best", PRETRAINED):
        raise UsageError(f"--pretrained and --checkpoint exclude each other: leave out --checkpoint {checkpoint}")
    return PRETRAINED


def parse_changes(settings: list[str], sim: Engine | None = None) -> EnvChanges:
    """Read the `--set` options and the engine of a command that changes an environment; `--sim` overrides `--set`."""
    from rlctl.engine import Engine
    from rlctl.environments.spec import EnvChanges

    if not settings:
        return EnvChanges(sim=sim or Engine())
    from rlctl.recipe.sources import parse_changes  # takes a quarter of a second

    return parse_changes(settings, sim)
