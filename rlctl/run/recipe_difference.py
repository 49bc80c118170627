"""What differs between two recipes, key by key."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlctl.run.recipe import Recipe

ABSENT = "(not set)"


def find_difference(recipe: Recipe, base: Recipe) -> dict[str, tuple[Any, Any]]:
    """Return per dotted key that differs the value in `recipe` and the one in `base`; the seed is not compared."""
    ours, theirs = (dict(_flatten(each.model_dump(mode="json", by_alias=True))) for each in (recipe, base))
    keys = dict.fromkeys([*theirs, *ours])
    pairs = {key: (ours.get(key, ABSENT), theirs.get(key, ABSENT)) for key in keys if key != "seed"}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}


def _flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten(value, f"{prefix}{key}.")
        elif value != {}:
            yield prefix + key, value
