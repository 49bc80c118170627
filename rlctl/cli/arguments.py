"""Arguments and options that several commands share."""

from __future__ import annotations

import dataclasses
import inspect
import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlctl import output
from rlctl.cli import completion
from rlctl.options import Argument, Option, Settings

if TYPE_CHECKING:
    from rlctl.environments.spec import EnvChanges

_COMPLETIONS = {
    "task": completion.complete_task,
    "run": completion.complete_run,
    "algorithm": completion.complete_algorithm,
}


@dataclasses.dataclass(frozen=True)
class RecipeFlags:
    """Recipe keys from the command line; a flag overrides `--set`."""

    settings: Settings = dataclasses.field(default_factory=list)
    algo: Annotated[
        str | None, Option("ppo, a2c, sac, td3, ddpg, dqn, tqc, crossq or recurrent_ppo.", completes="algorithm")
    ] = None
    seed: Annotated[int | None, Option("Seed of everything random.")] = None
    total_timesteps: Annotated[
        str | None, Option("Environment steps; 1e6 is fine.", ("--total-timesteps", "-n"), metavar="STEPS")
    ] = None
    n_envs: Annotated[int | None, Option("Environments stepped in parallel.", min=1)] = None
    track: Annotated[str | None, Option("Also send the run to wandb, mlflow or trackio.", metavar="TRACKER")] = None

    def merge(self) -> dict[str, Any]:
        """Return all keys and values, nested as in a recipe."""
        from rlctl.recipe.sources import merge_flags

        return merge_flags(**vars(self))


def suggest_setting(option: str) -> str | None:
    """Return `--set algo_kwargs.learning_rate=` for `--lr` or `--learning-rate`; None where no recipe has the key."""
    from rlctl.recipe.hyperparameters import ALGORITHM_PARAMETERS
    from rlctl.recipe.recipe import Recipe

    name = option.lstrip("-").replace("-", "_")
    name = {"lr": "learning_rate"}.get(name, name)
    if any(name in parameters.model_fields for parameters in ALGORITHM_PARAMETERS.values()):
        return f"--set algo_kwargs.{name}="
    return f"--set {name}=" if name in Recipe.model_fields else None


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function for Typer: the option fields of a dataclass parameter replace the parameter."""
    parameters, requests = [], {}
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        if not dataclasses.is_dataclass(parameter.annotation):
            parameters.append(_make_parameter(parameter.name, parameter.annotation, parameter.default))
            continue
        request: Any = parameter.annotation
        hints = typing.get_type_hints(request, include_extras=True)
        fields = [field for field in dataclasses.fields(request) if _find_option(hints[field.name])]
        parameters += [_make_parameter(field.name, hints[field.name], _find_default(field)) for field in fields]
        requests[parameter.name] = (request, {field.name: _turns_off(hints[field.name]) for field in fields})

    def run(**values: Any) -> None:
        output.results()  # reserves stdout for the result: plugins print to stderr from now on
        for name, (request, fields) in requests.items():
            # A flag that turns a field off is True if the field must become False.
            arguments = {field: values.pop(field) != turns_off for field, turns_off in fields.items() if turns_off}
            values[name] = request(**arguments, **{field: values.pop(field) for field in fields if field in values})
        return function(**values)

    run.__name__, run.__doc__ = function.__name__, function.__doc__
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _find_option(annotation: Any) -> Option | None:
    return next((data for data in getattr(annotation, "__metadata__", ()) if isinstance(data, Option)), None)


def _turns_off(annotation: Any) -> bool:
    option = _find_option(annotation)
    return option is not None and any(flag.startswith("/") for flag in option.flags)


def _find_default(field: dataclasses.Field[Any]) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _make_parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    if (option := _find_option(annotation)) is not None:
        kind = annotation.__origin__
        default = False if _turns_off(annotation) else default
        annotation = Annotated[kind, _make_typer_option(option, shows_default=kind is not bool)]
    default = inspect.Parameter.empty if default is dataclasses.MISSING else default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _make_typer_option(option: Option, *, shows_default: bool) -> Any:
    """Return Typer's option or argument for a request's field."""
    make = typer.Argument if isinstance(option, Argument) else typer.Option
    return make(
        *(flag.removeprefix("/") for flag in option.flags),
        help=option.help,
        metavar=option.metavar,
        min=option.min,
        max=option.max,
        autocompletion=None if option.completes is None else _COMPLETIONS[option.completes],
        show_default=option.default_text or shows_default,
    )


def choose_checkpoint(checkpoint: str, pretrained: bool) -> str:
    """Return the requested policy, from `--checkpoint` or `--pretrained`."""
    if not pretrained:
        return checkpoint
    from rlctl.errors import UsageError
    from rlctl.policy.shipped import PRETRAINED

    if checkpoint not in ("best", PRETRAINED):
        raise UsageError(f"--pretrained and --checkpoint exclude each other: leave out --checkpoint {checkpoint}")
    return PRETRAINED


def parse_changes(settings: list[str]) -> EnvChanges:
    """Read the `--set` options of a command that changes an environment."""
    from rlctl.environments.spec import UNCHANGED

    if not settings:
        return UNCHANGED
    from rlctl.recipe.sources import parse_changes  # takes a quarter of a second

    return parse_changes(settings)
