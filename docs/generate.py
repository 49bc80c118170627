"""Writes `recipe.md` and the JSON schema of recipes: `python docs/generate.py`."""

from __future__ import annotations

import inspect
import json
import pathlib
from collections.abc import Iterator
from typing import Any

from rlctl.recipe.hyperparameters import ALGORITHM_PARAMETERS
from rlctl.recipe.network_parameters import NETWORK_PARAMETERS
from rlctl.recipe.recipe import ALGORITHMS, SCHEMA_FILE, build_schema
from rlctl.recipe.recipe_files import list_presets, read_comment
from rlctl.storage import validation, yaml_text
from rlctl.storage.validation import Schema

Path = tuple[str | int, ...]

_OWN_TABLES = ("stages", "algo_kwargs", "policy_kwargs")

_GROUPED_DIGITS = {"type": "string", "pattern": r"^-?[0-9][0-9_]*(\.[0-9_]+)?$"}
"""`200_000`: rlctl reads a number, editors read text."""
_BOUNDS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}
_NUMBER = r"[0-9.]+(e[+-]?[0-9]+)?"
_FOR_IMAGES = {"$ref": "#/$defs/_FeaturesExtractor"}
_LINE = 120  # [characters]
_KWARGS = ("algo_kwargs", "policy_kwargs")
_HEAD = """# Recipes

A recipe says how to train a task. rlctl merges four sources; a later one overrides an earlier one: the defaults on this
page, the task's own recipe (a YAML file next to its module: `rlctl tasks show TASK` prints it), `--config FILE`, and
`--set KEY=VALUE` with the other flags of `rlctl train`. Every training writes the result to `recipe.yaml` of its run,
which is itself a valid `--config`.

```yaml
algo: ppo
algo_kwargs: {learning_rate: 3e-4, gamma: 0.98}
policy_kwargs: {net_arch: [64, 64]}
n_envs: 16
total_timesteps: 200_000
eval: {every_steps: 20_000, episodes: 50}
```

`--algo sac` on a recipe for PPO keeps its task, `n_envs` and `total_timesteps`, so that the comparison is fair. What
only fits the other algorithm (`algo_kwargs`, `policy_kwargs`, `normalize`, `her`, `mirror`) gets its defaults, and a
line says so.

YAML 1.2: `3e-4` is a number, `1e6` is a whole number where one is expected, `on` is text. Anchors, aliases and tags are
not supported. A key of `--set` has dots: `--set algo_kwargs.gamma=0.98`. `check-env`, `eval` and `replay` accept only
keys of `task`, `reward_weights`, `randomize` and `events`; `--set randomize=false` also turns off the events that the
policy was trained with.

Defaults marked *rlctl* are chosen by rlctl; all others are those of Stable-Baselines3.

`--config presets/NAME` uses a recipe that comes with rlctl. It overrides the task's own recipe, as a file does. A
Gymnasium id has the preset of its name, or of another version of it, as its own recipe: `rlctl train Reacher-v5` trains
by `presets/reacher-v5`.

{presets}

This page is generated: `python docs/generate.py`. For editors there is a
[JSON schema](../rlctl/recipe/recipe.schema.json): `rlctl recipe --schema`.
"""
_STAGES = """
Stages are a curriculum. Each stage changes the recipe's own task; all but the last need a rule that ends them:

```yaml
stages:
  - {task: {tolerance: 0.2}, promote: {success: 0.8, window: 100}}
  - {task: {tolerance: 0.05}}
```
"""


def render_recipe_page() -> str:
    """Return the page about recipes."""
    lines = [
        _HEAD.replace("{presets}", "\n".join(_render_presets())),
        "## Keys",
        "",
        *_render_table(build_schema(None), ()),
    ]
    lines += [_STAGES, *_render_table(build_schema(None), ("stages", 0))]
    for algo in ALGORITHM_PARAMETERS:
        for key, models in (("algo_kwargs", ALGORITHM_PARAMETERS), ("policy_kwargs", NETWORK_PARAMETERS)):
            model = models[algo]
            heading = f"## {algo}\n\n" if key == "algo_kwargs" else ""
            lines += ["", f"{heading}`{key}`: {inspect.cleandoc(model.__doc__ or '')}", ""]
            lines += _render_table(build_schema(algo), (key,))
    return "\n".join(lines) + "\n"


def _render_presets() -> Iterator[str]:
    """Yield a line for each preset, with the first sentence of its file's comment."""
    for name, file in list_presets().items():
        yield f"- `{name}`: {read_comment(file).partition('. ')[0].rstrip('.')}."


def _render_table(root: Schema, path: Path) -> list[str]:
    return ["| key | value | default | meaning |", "|---|---|---|---|", *_render_rows(root, path, "")]


def _render_rows(root: Schema, path: Path, prefix: str) -> Iterator[str]:
    """Yield a row for each key of the mapping at `path`, and below it the keys of the mapping that it is, if so."""
    for key in validation.list_keys(root, validation.find_schema(root, path)):
        part = validation.find_schema(root, (*path, key))
        value = validation.describe_value(root, part).replace("|", "\\|")
        yield f"| `{prefix}{key}` | {value} | {_render_default(part)} | {part.get('description', '')} |"
        if key not in _OWN_TABLES and "examples" not in part:
            yield from _render_rows(root, (*path, key), f"{prefix}{key}.")


def _render_default(part: Schema) -> str:
    if "default_text" in part:
        return str(part["default_text"])
    default = part.get("default", {})
    return "" if isinstance(default, dict) else yaml_text.dump(default).partition("\n")[0]


def build_json_schema() -> dict[str, Any]:
    """Return the schema of a recipe, whose `algo_kwargs` and `policy_kwargs` depend on `algo`."""
    root = dict(build_schema(None))
    definitions = dict(root.pop("$defs", {}))
    conditions = []
    for algo in ALGORITHMS:
        schema = build_schema(algo)
        definitions |= schema.get("$defs", {})
        condition: dict[str, Any] = {"properties": {"algo": {"const": algo}}}
        if algo != "ppo":  # the default
            condition["required"] = ["algo"]
        parameters = {key: schema["properties"][key] for key in _KWARGS}
        conditions.append({"if": condition, "then": {"properties": parameters}})
    described = {**root, "allOf": conditions, "$defs": definitions}
    converted: dict[str, Any] = _convert(described)
    converted["$defs"]["GroupedDigits"] = _GROUPED_DIGITS
    return {"$schema": "http://json-schema.org/draft-07/schema#", **converted}


def render_json_schema() -> str:
    """Return the schema as text: keys sorted, each property of a recipe on a line of its own."""
    return _format_json(build_json_schema()) + "\n"


def _format_json(node: Any, indent: str = "", *, expand: bool = False) -> str:
    text = json.dumps(node, sort_keys=True)
    if len(indent + text) <= _LINE or not (expand or '"properties"' in text):
        return text
    inner = f"{indent} "
    if isinstance(node, list):
        return "[\n" + ",\n".join(inner + _format_json(part, inner) for part in node) + f"\n{indent}]"
    lines = (
        f"{inner}{json.dumps(key)}: {_format_json(node[key], inner, expand=key == 'properties')}"
        for key in sorted(node)
    )
    return "{\n" + ",\n".join(lines) + f"\n{indent}}}"


def _convert(node: Any) -> Any:
    """Return part of a schema with standard keywords only, and with numbers that may have grouped digits."""
    if isinstance(node, list):
        return [_convert(part) for part in node]
    if not isinstance(node, dict):
        return node
    known = {_BOUNDS.get(key, key): value for key, value in node.items() if key != "default_text"}
    if isinstance(known.get("title"), str):  # the key itself in other letters
        del known["title"]
    if isinstance(pattern := node.get("pattern"), str):  # written for people: lin_NUMBER
        known["pattern"] = f"^{pattern.replace('NUMBER', _NUMBER)}$"
    if _FOR_IMAGES in node.get("anyOf", ()):  # the arguments of a user's class have any names
        known["anyOf"] = [*node["anyOf"], {"type": "object"}]
    if node.get("type") in ("integer", "number"):
        about = {key: known.pop(key) for key in ("description", "default") if key in known}
        return {**about, "anyOf": [known, {"$ref": "#/$defs/GroupedDigits"}]}
    return {key: _convert(value) for key, value in known.items()}


def render_pages() -> dict[str, str]:
    """Return the generated files by name."""
    return {
        "recipe.md": render_recipe_page(),
        str(SCHEMA_FILE): render_json_schema(),
    }


if __name__ == "__main__":
    for name, text in render_pages().items():
        (pathlib.Path(__file__).parent / name).write_text(text, encoding="utf-8")
