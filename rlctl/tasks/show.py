"""What `rlctl tasks show` prints."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from rlctl import output
from rlctl.eval.score import describe_score
from rlctl.run.policy import PolicyInfo
from rlctl.run.stages import Stage
from rlctl.tasks.definition import Definition, OfferedEvent
from rlctl.tasks.description import Description, Quantity
from rlctl.tasks.plain_data import to_plain

if TYPE_CHECKING:
    from rich.console import Console

Row = tuple[str, ...]

_LONGEST_SPACE = 100  # [characters]; JSON has all of it


def show(description: Description, json: str | None) -> None:
    """Print a description, or JSON alone for `-`."""
    if json is not None:
        output.write_result_json(json, as_json(description))
    if json == "-":
        return
    from rich.text import Text

    out = output.out()
    out.print(Text.assemble((description.task, "bold"), f"  {description.summary}".rstrip()))
    _print_rows(out, _list_facts(description), indent=0)
    definition = description.definition
    _print_section(
        out, f"observation  {_shorten(description.observation_space)}", _list_quantities(description.observations)
    )
    _print_section(out, f"action  {_shorten(description.action_space)}", _list_actions(description))
    _print_section(out, "parameters  --set task.NAME=VALUE", _list_parameters(description), none="none")
    if definition is not None:
        _print_section(out, "reward terms", _list_rewards(definition))
        _print_section(out, "events", [_format_event(each) for each in definition.events], none="none")
        if definition.model_faults:
            _print_section(out, "model files", [(fault,) for fault in definition.model_faults])
    if description.recipe.stages:
        _print_section(
            out, "stages", [_format_stage(number, each) for number, each in enumerate(description.recipe.stages, 1)]
        )
    _print_section(out, f"recipe  {description.recipe_file or 'none packaged; the defaults'}", ())
    for line in description.recipe.to_yaml().splitlines():
        out.print(Text(f"  {line}"))
    _print_section(out, f"shipped policy  {description.policy_file or 'none'}", _list_scores(description.policy))


def as_json(description: Description) -> dict[str, Any]:
    """Return a description as plain data."""
    content: dict[str, Any] = to_plain(
        {
            **dataclasses.asdict(dataclasses.replace(description, policy=None)),
            "recipe": description.recipe.model_dump(by_alias=True),
            "policy": None if (info := description.policy) is None else _summarize_policy(info),
        }
    )
    return content


def _summarize_policy(info: PolicyInfo) -> dict[str, Any]:
    provenance = info.provenance
    return {
        "algo": info.algo,
        "training_steps": info.training_steps,
        "provenance": None if provenance is None else provenance.model_dump(mode="json"),
    }


def _list_scores(info: PolicyInfo | None) -> list[Row]:
    """Return the measured scores: of the shipped policy, of zero and of random actions."""
    if info is None:
        return []
    steps = f"{info.algo}, {info.training_steps:,} steps"
    if (known := info.provenance) is None:
        return [("policy", steps)]
    scores = {f"policy ({steps})": known.score, **known.baselines}
    return [(name, *describe_score(score).split(", ")) for name, score in scores.items()]


def _print_section(out: Console, title: str, rows: Iterable[Row], none: str = "") -> None:
    from rich.text import Text

    name, _, rest = title.partition("  ")
    found = list(rows)
    out.print()
    out.print(Text.assemble((name, "bold"), f"  {rest if found or not none else none}".rstrip()))
    _print_rows(out, found, indent=2)


def _print_rows(out: Console, rows: list[Row], indent: int) -> None:
    """Print a table without a head: in columns that fold on a terminal, and as lines without an end elsewhere."""
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    if not out.is_terminal:
        widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))] if rows else []
        for row in rows:
            cells = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            out.print(Text(" " * indent + cells.rstrip()))
        return
    table = Table(box=None, pad_edge=False, show_header=False)
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    if rows:
        out.print(Padding(table, (0, 0, 0, indent)))


def _list_facts(description: Description) -> list[Row]:
    facts = [("class", description.target)]
    if description.distribution:
        facts.append(("origin", f"{description.distribution} {description.version}"))
    if description.file:
        facts.append(("file", description.file))
    definition, steps = description.definition, description.max_steps
    if definition is None:
        limit = f"truncated after {steps:,} steps" if steps else "no time limit that Gymnasium knows of"
        return [*facts, ("episode", limit)]
    if definition.robot:
        facts.append(("robot", definition.robot))
    return [
        *facts,
        ("control", f"{_format_number(definition.control_dt)} s per action, {definition.substeps} physics steps each"),
        ("episode", f"{_format_number(definition.episode_s)} s, {steps:,} steps"),
        ("success", "is_success, at the end of an episode" if definition.has_success else "not defined"),
    ]


def _shorten(space: str) -> str:
    """Leave out the bounds of a large space, or the parts, which the rows below it have."""
    return space if len(space) <= _LONGEST_SPACE else f"{space.partition('(')[0]}(...)"


def _list_quantities(quantities: list[Quantity]) -> list[Row]:
    return [
        (each.name, _format_size(each), each.unit or "", _format_bounds(each))
        for each in quantities
        if each.name  # without one it is the whole space, which the title has
    ]


def _format_size(quantity: Quantity) -> str:
    return "x".join(map(str, quantity.shape)) if quantity.kind == "Box" else quantity.kind


def _format_bounds(quantity: Quantity) -> str:
    if quantity.low is None and quantity.high is None:
        return "unbounded"
    low, high = ("-inf" if quantity.low is None else _format_number(quantity.low)), quantity.high
    return f"{low} to {'inf' if high is None else _format_number(high)}"


def _list_actions(description: Description) -> list[Row]:
    meaning = description.definition.action_meaning if description.definition else ""
    return [(meaning,)] if meaning else _list_quantities(description.actions)


def _list_parameters(description: Description) -> list[Row]:
    trained = description.recipe.task
    return [
        (
            each.name,
            each.type,
            "required" if each.required else _format_value(each.default),
            f"{_format_value(trained[each.name])} in the recipe" if each.name in trained else "",
        )
        for each in description.parameters
    ]


def _list_rewards(definition: Definition) -> list[Row]:
    return [
        (
            term.name,
            f"{term.weight:g}" + (" (a metric)" if term.weight == 0 else ""),
            "" if term.weight == term.default else f"{term.default:g} in the task",
        )
        for term in definition.rewards
    ]


def _format_event(event: OfferedEvent) -> Row:
    parameters = dict(event.parameters)
    when = event.when
    if "every_s" in parameters:
        when = f"every {_format_value(parameters.pop('every_s'))} s"
    arguments = ", ".join(f"{name} {_format_range(value)}" for name, value in parameters.items())
    acts = "always" if event.enabled else "with this recipe" if event.acts else "with randomize=true"
    return event.name, when, event.function, arguments, acts


def _format_stage(number: int, stage: Stage) -> Row:
    rule = stage.promote.model_dump(by_alias=True, exclude_none=True, exclude_defaults=True) if stage.promote else {}
    until = ", ".join(f"{name} {_format_value(value)}" for name, value in rule.items())
    return str(number), str(stage), f"until {until}" if until else "the last, which is evaluated"


def _format_range(value: Any) -> str:
    """Write what an event draws from: `0.8..1.2`, or `0.9..1.1 -> 0.8..1.2` for a range that widens."""
    if isinstance(value, Mapping) and value.keys() == {"from", "to"}:
        return f"{_format_range(value['from'])} -> {_format_range(value['to'])}"
    if isinstance(value, list) and len(value) == 2 and all(isinstance(each, int | float) for each in value):
        return f"{_format_number(value[0])}..{_format_number(value[1])}"
    return _format_value(value)


def _format_value(value: Any) -> str:
    if isinstance(value, float):
        return _format_number(value)
    if isinstance(value, list):
        return f"[{', '.join(map(_format_value, value))}]"
    return str(value)


def _format_number(value: float) -> str:
    return f"{value:.6g}"
