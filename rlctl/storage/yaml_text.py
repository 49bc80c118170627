"""YAML with the scalars of version 1.2: `3e-4` is a number, `on` is text. Duplicate keys are errors."""

import re
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import yaml

from rlctl.errors import RecipeError, short_repr
from rlctl.storage import untrusted

if TYPE_CHECKING:
    from pydantic import BaseModel

Model = TypeVar("Model", bound="BaseModel")

_PREFIX = "tag:yaml.org,2002:"
_DEEPEST = 50
_LONGEST = 2**20  # [bytes] of a file
_MOST_VALUES = 100_000  # of a file of another project
_MOST_DIGITS = 100  # of a whole number; Python itself refuses thousands


class _Dumper(yaml.SafeDumper):
    pass


class _Loader(yaml.SafeLoader):
    depth = 0
    is_foreign = False
    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # filled below: no dates

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: yaml.Event = self.peek_event()  # type: ignore[no-untyped-call]
        if getattr(event, "anchor", None) is not None and not self.is_foreign:  # of an alias too
            raise _make_error("anchors and aliases (&name, *name) are not supported: write the values out", event)
        if self.is_foreign and getattr(event, "tag", None) is not None:
            event.tag, event.implicit = None, _UNTAGGED.get(type(event), True)  # type: ignore[attr-defined]
        if getattr(event, "tag", None) is not None:  # bytes, sets, objects of Python
            raise _make_error("tags (!!int, !name) are not supported: write the value alone", event)
        if self.depth >= _DEEPEST:
            raise _make_error(f"nested more than {_DEEPEST} deep", event)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = _check_key(key_node)
            if key in seen:
                raise _make_error(f"key {key!r} is given twice", key_node)
            seen.add(key)
        return super().construct_mapping(node, deep)

    def construct_int(self, node: yaml.ScalarNode) -> int:
        text = self.construct_scalar(node).replace("_", "")
        base = 0 if text.startswith(("0x", "0o")) else 10
        if len(text) > _MOST_DIGITS or abs(number := int(text, base)) >= 2**63:
            raise _make_error(f"{short_repr(text)} is too large a number", node)
        return number

    def construct_float(self, node: yaml.ScalarNode) -> float:
        return float(self.construct_scalar(node).replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan"))


class _ForeignLoader(_Loader):
    is_foreign = True

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None:
            _count_values(node, {})
        return node


def _count_values(node: yaml.Node, sizes: dict[int, int]) -> int:
    """Return how many values a node has, those of aliases each time; raises an error for too many."""
    known = sizes.get(id(node))
    if known is not None:
        return known
    sizes[id(node)] = _MOST_VALUES  # until its parts are counted: one that contains itself has too many
    parts: list[yaml.Node] = []
    if isinstance(node, yaml.MappingNode):
        parts = [part for pair in node.value for part in pair]
    elif isinstance(node, yaml.SequenceNode):
        parts = node.value
    sizes[id(node)] = 1 + sum(_count_values(part, sizes) for part in parts)
    if sizes[id(node)] > _MOST_VALUES:
        raise _make_error(f"anchors and aliases make more than {_MOST_VALUES:,} values of it", node)
    return sizes[id(node)]


_UNTAGGED: dict[type[Any], Any] = {yaml.ScalarEvent: (True, False)}


def _make_error(message: str, node: Any) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(problem=message, problem_mark=node.start_mark)


def _check_key(node: yaml.Node) -> str:
    if node.tag != f"{_PREFIX}str" or not isinstance(node.value, str):
        shown = short_repr(node.value) if isinstance(node.value, str) else "a list or a mapping"
        raise _make_error(f"{shown} cannot be a key: keys are text, numbers in quotes", node)
    return node.value


_Loader.add_constructor(f"{_PREFIX}int", _Loader.construct_int)
_Loader.add_constructor(f"{_PREFIX}float", _Loader.construct_float)
# https://yaml.org/spec/1.2.2/#103-core-schema, and digits grouped by underscores.
for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9][0-9_]*|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9_]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+0123456789."),
    ),
):
    # The dumper quotes text that is a number in YAML 1.1 or 1.2.
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(f"{_PREFIX}{_tag}", re.compile(f"^(?:{_pattern})$"), _first)


def read_text(path: Path) -> str:
    """Return the text of a YAML file; raises `ArtifactError` if it cannot be read, `RecipeError` if it is not UTF-8."""
    try:
        return untrusted.read_bytes(path, _LONGEST).decode()
    except UnicodeDecodeError as error:
        raise RecipeError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start:,}; save it as UTF-8") from None


def load(text: str, source: str, *, foreign: bool = False) -> Any:
    """Parse YAML without anchors and aliases; raises `RecipeError` with `source` and the line.

    A `foreign` file, of another project, may have them, as long as they do not multiply its values. In it a value with
    a tag, such as an object of Python, is read as the text, list or mapping that it is written as; nothing is
    constructed of it.
    """
    try:
        loader = _ForeignLoader(text) if foreign else _Loader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except RecursionError:
        raise RecipeError(f"{source}: nested more than {_DEEPEST} deep") from None
    except yaml.reader.ReaderError as error:
        raise RecipeError(f"{source}: character {error.character:#x} at {error.position:,} cannot be in YAML") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{source}:{mark.line + 1}" if mark else source
        problem = getattr(error, "problem", None) or str(error)
        if isinstance(error, yaml.composer.ComposerError) and error.context:
            problem = f"{error.context}, {problem}"
        if "'\\t'" in problem:
            problem = "a tab: indent and separate with spaces"
        raise RecipeError(f"{where}: {short_repr(problem, 200)}") from None


def find_line(text: str, path: Sequence[str | int]) -> int:
    """Return the line, from 1, of the key at `path` in valid YAML."""
    loader = _Loader(text)
    node = loader.get_single_node()
    line = 1
    for part in path:
        if isinstance(node, yaml.MappingNode):
            key, node = next((key, value) for key, value in node.value if key.value == part)
            line = key.start_mark.line + 1
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int):
            node = node.value[part]
            line = node.start_mark.line + 1
    loader.dispose()
    return line


def read_model(path: Path, model: type[Model]) -> Model:
    """Read a YAML file as a pydantic model whose descriptions have units in brackets.

    Raises `ArtifactError` if it cannot be read, `RecipeError` with the line of each wrong value.
    """
    from pydantic import ValidationError

    from rlctl.storage import validation

    text = read_text(path)
    content = load(text, str(path))
    try:
        return model.model_validate(content)
    except ValidationError as error:
        schema = model.model_json_schema()

        def explain(problem: Any, place: validation.Place) -> str:
            unit = re.search(r"\[(.+?)\]", validation.find_schema(schema, place).get("description", ""))
            key = ".".join(str(part) for part in place)
            message = validation.explain(problem, place, schema, content, key=key, unit=unit[1] if unit else "")
            return f"{path}:{find_line(text, place)}: {message}"

        raise RecipeError(validation.explain_all(error, schema, explain)) from None


def dump(value: Any) -> str:
    """Return plain data as YAML, with the keys in their order."""
    return str(yaml.dump(value, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=100))
