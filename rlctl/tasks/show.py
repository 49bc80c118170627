"""Prints `rlctl tasks show`."""

from collections.abc import Iterable, Mapping
from typing import Any

from rlctl import output
from rlctl.evaluation.report import describe_score
from rlctl.policy.file import PolicyInfo
from rlctl.recipe.stages import Stage
from rlctl.tasks.description import Description

Cells = tuple[str, ...]
Json = Mapping[str, Any]

_LONGEST_SPACE = 100  # [characters]; the JSON has the full text


def show(description: Description, json: str | None) -> None:
    """Print a description, or only JSON for `-`."""
    content = description.content
    if output.present(content, json):
        return
    from rich.text import Text

    out, recipe = output.out(), description.recipe
    out.print(Text.assemble((content["task"], "bold"), f"  {content['summary']}".rstrip()))
    _print_rows(_list_facts(content))
    definition = content["definition"]
    parts = _list_quantities(content["observations"])
    _print_section(f"observation  {_shorten(content['observation_space'])}", parts)
    if definition is not None and definition["cameras"]:
        rows = [_format_camera(name, camera) for name, camera in definition["cameras"].items()]
        _print_section("cameras  --observe NAME,... of rlctl distill", rows)
    meaning = definition["action_meaning"] if definition else ""
    actions = [(meaning,)] if meaning else _list_quantities(content["actions"])
    _print_section(f"action  {_shorten(content['action_space'])}", actions)
    _print_section("joints", _list_joints(content["joints"]))
    parameters = _list_parameters(content["parameters"], recipe.task)
    _print_section("parameters  --set task.NAME=VALUE", parameters, none="none")
    if definition is not None:
        _print_section("reward terms", _list_rewards(definition["rewards"]))
        _print_section("events", [_format_event(event) for event in definition["events"]], none="none")
        if definition["model_faults"]:
            _print_section("model files", [(fault,) for fault in definition["model_faults"]])
    if recipe.stages:
        _print_section("stages", [_format_stage(number, stage) for number, stage in enumerate(recipe.stages, 1)])
    _print_section(f"recipe  {content['recipe_file'] or 'none packaged; defaults'}", ())
    for line in recipe.to_yaml().splitlines():
        out.print(Text(f"  {line}"))
    _print_section(f"shipped policy  {content['policy_file'] or 'none'}", _list_scores(description.policy))


def _list_scores(info: PolicyInfo | None) -> list[Cells]:
    if info is None:
        return []
    steps = f"{info.algo}, {info.training_steps:,} steps"
    if (known := info.provenance) is None:
        return [("policy", steps)]
    scores = {f"policy ({steps})": known.score, **known.baselines}
    return [(name, *describe_score(score).split(", ")) for name, score in scores.items()]


def _print_section(title: str, rows: Iterable[Cells], none: str = "") -> None:
    from rich.text import Text

    name, _, rest = title.partition("  ")
    out, listed = output.out(), list(rows)
    out.print()
    out.print(Text.assemble((name, "bold"), f"  {rest if listed or not none else none}".rstrip()))
    _print_rows(listed, indent="  ")


def _print_rows(rows: list[Cells], indent: str = "") -> None:
    if rows:
        output.print_table([""] * len(rows[0]), [(indent + row[0], *row[1:]) for row in rows], left=("",))


def _list_facts(content: Json) -> list[Cells]:
    definition, steps, control_dt = content["definition"], content["max_steps"], content["control_dt"]
    facts = {
        "class": content["target"],
        "origin": f"{content['distribution']} {content['version']}" if content["distribution"] else None,
        "file": content["file"],
        "mass": f"{content['mass']:.4g} kg" if content["mass"] is not None else None,
        "robot": definition["robot"] if definition is not None else None,
        "control": f"{control_dt:.6g} s per action" if control_dt else None,
        "episode": f"truncated after {steps:,} steps" if steps else "no known time limit",
    }
    if definition is not None:
        facts["control"] = f"{control_dt:.6g} s per action, {definition['substeps']} physics steps each"
        facts["episode"] = f"{definition['episode_s']:.6g} s, {steps:,} steps"
        facts["success"] = "is_success, at the end of an episode" if definition["has_success"] else "not defined"
    return [(name, fact) for name, fact in facts.items() if fact]


def _format_camera(name: str, camera: Json) -> Cells:
    width, height = camera["size"]
    place = "stands still" if camera["body"] is None else f"on {camera['body']}"
    if camera["link"] is not None:
        place = f"{place}, {camera['link']}"
    return name, f"{width} x {height} pixels", place


def _shorten(space: str) -> str:
    """Leave out the bounds or parts of a large space; the rows below show them."""
    return space if len(space) <= _LONGEST_SPACE else f"{space.partition('(')[0]}(...)"


def _list_quantities(quantities: list[Json]) -> list[Cells]:
    rows = []
    for quantity in quantities:
        size = "x".join(map(str, quantity["shape"])) if quantity["kind"] == "Box" else str(quantity["kind"])
        rows.append((quantity["name"], size, quantity["unit"] or "", _format_bounds(quantity["low"], quantity["high"])))
    return [row for row in rows if row[0]]  # an unnamed part is the whole space, which is in the title


def _format_bounds(low: float | None, high: float | None) -> str:
    if low is None and high is None:
        return "unbounded"
    return f"{'-inf' if low is None else _format_value(low)} to {'inf' if high is None else _format_value(high)}"


def _list_joints(joints: Json | None) -> list[Cells]:
    if joints is None:
        return []
    columns = [
        [f"{low:.4g} to {high:.4g}" for low, high in zip(joints["low"], joints["high"], strict=True)],
        [f"speed {value:.4g}" for value in joints["max_speed"]],
        [f"torque {value:.4g}" for value in joints["max_torque"]],
    ]
    return list(zip(joints["names"], *(column for column in columns if column), strict=True))


def _list_parameters(parameters: list[Json], trained: Mapping[str, Any]) -> list[Cells]:
    return [
        (
            (name := parameter["name"]),
            parameter["type"],
            "required" if parameter["required"] else _format_value(parameter["default"]),
            f"{_format_value(trained[name])} in the recipe" if name in trained else "",
        )
        for parameter in parameters
    ]


def _list_rewards(terms: list[Json]) -> list[Cells]:
    return [
        (
            term["name"],
            f"{term['weight']:g}" + (" (a metric)" if term["weight"] == 0 else ""),
            "" if term["weight"] == term["default"] else f"{term['default']:g} in the task",
        )
        for term in terms
    ]


def _format_event(event: Json) -> Cells:
    parameters, when = dict(event["parameters"]), event["when"]
    if "every_s" in parameters:
        when = f"every {_format_value(parameters.pop('every_s'))} s"
    arguments = ", ".join(f"{name} {_format_range(value)}" for name, value in parameters.items())
    acts = "with this recipe" if event["acts"] else "with randomize=true"
    if event["enabled"]:
        acts = "always"
    return event["name"], when, event["function"], arguments, acts


def _format_stage(number: int, stage: Stage) -> Cells:
    rule = stage.promote.model_dump(by_alias=True, exclude_none=True, exclude_defaults=True) if stage.promote else {}
    until = ", ".join(f"{name} {_format_value(value)}" for name, value in rule.items())
    return str(number), str(stage), f"until {until}" if until else "last stage, used for evaluation"


def _format_range(value: Any) -> str:
    """Format an event's range: `0.8..1.2`, or `0.9..1.1 -> 0.8..1.2` if it widens."""
    if isinstance(value, Mapping) and value.keys() == {"from", "to"}:
        return f"{_format_range(value['from'])} -> {_format_range(value['to'])}"
    if isinstance(value, list) and len(value) == 2 and all(isinstance(bound, int | float) for bound in value):
        return f"{value[0]:.6g}..{value[1]:.6g}"
    return _format_value(value)


def _format_value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return f"[{', '.join(map(_format_value, value))}]"
    return str(value)
