"""Strict types of the values in files that users write, and explanations of pydantic's errors.

Text and bools are not numbers, and numbers are not switches. An explanation says what the JSON schema expects, what was
given, and the closest name.
"""

import dataclasses
import difflib
import json
import numbers
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, TypeVar

import pydantic
from annotated_types import GroupedMetadata
from pydantic_core import PydanticCustomError

from rlctl.errors import RlctlError, did_you_mean, short_repr

Schema = dict[str, Any]
_Model = TypeVar("_Model", bound=pydantic.BaseModel)
Place = tuple[str | int, ...]  # keys and indices that lead to a value
_MOST_LINES = 3
_ANY = "any value"
_CLOSE = 0.7  # how alike a key is to the one that is meant, as `difflib` has it


class Section(pydantic.BaseModel, extra="forbid", frozen=True, use_attribute_docstrings=True):
    """A mapping in a file that users write. Unknown keys are errors; the text below a field describes it."""


Number = Annotated[float, pydantic.Strict(), pydantic.AllowInfNan(False)]
"""A finite number."""
Switch = pydantic.StrictBool
"""true or false."""


def _make_whole(value: Any) -> Any:
    if isinstance(value, numbers.Integral):  # of NumPy too
        return value if isinstance(value, bool) else int(value)
    return int(value) if isinstance(value, float) and value.is_integer() else value


Whole = Annotated[int, pydantic.Strict(), pydantic.BeforeValidator(_make_whole)]
"""A whole number; `1e6` is one."""


@dataclasses.dataclass(frozen=True)
class NumberAfter(GroupedMetadata):
    """Type of texts such as `lin_3e-4`: `prefix`, then a number of type `kind`."""

    prefix: str
    kind: Any

    def __iter__(self) -> Iterator[Any]:
        yield from (pydantic.Strict(), pydantic.AfterValidator(self._check))
        yield pydantic.WithJsonSchema({"type": "string", "pattern": f"{self.prefix}NUMBER"})

    def _check(self, text: str) -> str:
        try:
            pydantic.TypeAdapter(self.kind).validate_python(float(text.removeprefix(self.prefix)))
        except ValueError:
            text = ""
        if not text.startswith(self.prefix):
            # `explain` writes the message, from the type's JSON schema.
            raise PydanticCustomError("wrong_type", "wrong type")
        return text


def find_schema(root: Schema, path: Sequence[str | int]) -> Schema:
    """Return the part of a schema that describes the value at `path`, or the innermost value around it."""
    return _descend(root, path)[0]


def _descend(root: Schema, path: Sequence[str | int]) -> tuple[Schema, int]:
    # Also returns how many parts of `path` the schema has; the rest are pydantic's names of types in a union.
    node = root
    for depth, part in enumerate(path):
        parts = (_find_part(alternative, part) for alternative in _list_alternatives(root, node))
        inner = next(filter(None, parts), None)
        if inner is None:
            return node, depth
        node = inner
    return node, len(path)


def _find_part(node: Schema, part: str | int) -> Schema | None:
    if isinstance(part, int):
        return node.get("items")
    own: Schema | None = node.get("properties", {}).get(part)
    others = node.get("additionalProperties")
    return own or (others if isinstance(others, dict) else None)


def list_keys(root: Schema, node: Schema) -> list[str]:
    """Return the allowed keys of a mapping; none if `node` is not a mapping, or allows any key."""
    alternatives = _list_alternatives(root, node)
    return list(next((schema["properties"] for schema in alternatives if "properties" in schema), ()))


def describe_value(root: Schema, node: Schema) -> str:
    """Describe the allowed values: `a number in (0, 1]`, `a whole number in [1, 1e9] or -1`."""
    return " or ".join(dict.fromkeys(_describe(root, alternative) for alternative in _list_alternatives(root, node)))


def explain_all(error: pydantic.ValidationError, root: Schema, explain: Callable[[Any, Place], str]) -> str:
    """Return a line per wrong value, at most three; `explain` writes the line for a problem and its place."""
    problems: dict[Place, Any] = {}
    for problem in error.errors(include_url=False):
        problems.setdefault(_locate(problem, root), problem)  # of a union pydantic reports a problem per type
    lines = [explain(problem, place) for place, problem in problems.items()]
    return "\n".join(lines if len(lines) <= _MOST_LINES else [*lines[:2], f"and {len(lines) - 2} more mistakes"])


def explain_invalid(error: pydantic.ValidationError, model: Any, values: Any, label: str = "") -> str:
    """Explain the first problem of `values`, which were checked against `model`: a class of pydantic or an adapter.

    `LABEL.KEY: expected a number, got 'abc'`.
    """
    try:
        root = model.json_schema() if isinstance(model, pydantic.TypeAdapter) else model.model_json_schema()
    except pydantic.errors.PydanticInvalidForJsonSchema:  # a type that JSON does not have
        root = {}
    problem: Any = error.errors(include_url=False)[0]
    place = _locate(problem, root)
    return explain(problem, place, root, values, key=".".join(map(str, (label, *place) if label else place)))


def build(model: type[_Model], values: Mapping[str, Any], error: type[RlctlError], label: str) -> _Model:
    """Return a model of values that a user's code or file may have caused; raises `error` for invalid ones."""
    try:
        return model(**values)
    except pydantic.ValidationError as problem:
        raise error(explain_invalid(problem, model, values, label)) from None


def _locate(problem: Any, root: Schema) -> Place:
    path: Place = problem["loc"]
    return path if problem["type"] == "extra_forbidden" else path[: _descend(root, path)[1]]


def _suggest(name: str, keys: Sequence[str], root: Schema, path: Sequence[str | int], otherwise: str) -> str:
    """Return the closest key here, or the closest one inside of a key here: `gama` means `algo_kwargs.gamma`."""
    if difflib.get_close_matches(name, keys, n=1, cutoff=_CLOSE):
        return did_you_mean(name, keys)
    nested = {inner: f"{key}.{inner}" for key in keys for inner in list_keys(root, find_schema(root, [*path, key]))}
    closest = difflib.get_close_matches(name, nested, n=1, cutoff=_CLOSE)
    return f" Did you mean {nested[closest[0]]!r}?" if closest else did_you_mean(name, keys, otherwise)


def explain(
    problem: Any,
    path: Sequence[str | int],
    root: Schema,
    values: Any,
    *,
    key: str,
    of: str = "",
    unit: str = "",
    otherwise: str = "",
) -> str:
    """Explain what is wrong with the value at `path`, which the message calls `key`.

    `otherwise` is the key that is meant if this one is unknown and none is nearly the same.
    """
    if problem["type"] == "extra_forbidden":
        keys = list_keys(root, find_schema(root, path[:-1]))
        name, outer = path[-1], (find_schema(root, [*path[:-1], key_here]) for key_here in keys)
        inner = [f"{parent}.{name}" for parent, node in zip(keys, outer, strict=True) if name in list_keys(root, node)]
        hint = f" Did you mean {inner[0]!r}?" if inner else _suggest(str(name), keys, root, path[:-1], otherwise)
        return f"no key {key!r}{of}.{hint} Keys here: {', '.join(keys)}."
    label = f"{key}: " if key else ""
    if problem["type"] == "value_error":  # raised by a validator of rlctl
        return f"{label}{problem['ctx']['error']}"
    if problem["type"] == "missing":
        return f"{label}is missing"
    part, value = find_schema(root, path), values
    for part_key in path:
        value = value[part_key]
    expected = describe_value(root, part)
    if expected == _ANY:  # the schema has no words for the type
        return f"{label}{problem['msg'].removeprefix('Input ')}, got {short_repr(value)}"
    if unit:
        expected = f"{expected.removesuffix(' or null')} [{unit}]"
    examples = f", such as {' or '.join(part['examples'])}" if "examples" in part else ""
    words = [word for option in (part, *part.get("anyOf", ())) for word in option.get("enum", ())]
    close = did_you_mean(value, words) if isinstance(value, str) else ""
    got = repr(short_repr(value)) if isinstance(value, str) else short_repr(value)
    return f"{label}expected {expected}{examples}, got {got}{close and f'.{close}'}"


def _list_alternatives(root: Schema, node: Schema) -> Iterator[Schema]:
    if "$ref" in node:
        yield from _list_alternatives(root, root["$defs"][node["$ref"].rpartition("/")[2]])
    elif "anyOf" in node:
        for alternative in node["anyOf"]:
            yield from _list_alternatives(root, alternative)
    else:
        yield node


def _describe(root: Schema, node: Schema) -> str:
    if "const" in node:
        return node["const"] if isinstance(node["const"], str) else json.dumps(node["const"])
    if "enum" in node:
        return " or ".join(map(str, node["enum"]))
    if "pattern" in node:
        return str(node.get("text", node["pattern"]))
    if "prefixItems" in node:
        return f"[{', '.join(describe_value(root, item) for item in node['prefixItems'])}]"
    kind = node.get("type")
    if kind in ("integer", "number"):
        return f"{'a whole number' if kind == 'integer' else 'a number'}{_describe_range(node)}"
    if kind == "array":
        return f"a list, each element {describe_value(root, node['items'])}"
    if kind == "object":
        keys = list_keys(root, node)
        return f"a mapping of {', '.join(keys)}" if keys else "a mapping"
    return {"boolean": "true or false", "null": "null", "string": "text"}.get(str(kind), _ANY)


def _describe_range(node: Schema) -> str:
    low, above = node.get("minimum", node.get("ge")), node.get("exclusiveMinimum", node.get("gt"))
    high, below = node.get("maximum", node.get("le")), node.get("exclusiveMaximum", node.get("lt"))
    opening, least = ("(", above) if low is None else ("[", low)
    closing, most = (")", below) if high is None else ("]", high)
    if least is not None and most is not None:
        return f" in {opening}{_format_number(least)}, {_format_number(most)}{closing}"
    if least is not None:
        return f" {'>=' if low is not None else '>'} {_format_number(least)}"
    return ""


def _format_number(value: float) -> str:
    short = f"{value:.0e}".replace("e+0", "e").replace("e+", "e")
    return short if value >= 1e6 and float(short) == value else str(value)
