"""Names of recipes that are reported or compared together: what distinguishes each from the others."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from rlctl.errors import short_repr
from rlctl.recipe.recipe import Recipe, find_difference
from rlctl.recipe.stages import format_value

_SETTINGS_NAMED = 3


def name_recipes(recipes: Sequence[Recipe]) -> list[str]:
    """Return `learning_rate 0.001, gamma 0.98` for each recipe, of many the first; empty where none differs."""
    changes = [find_difference(recipe, recipes[0]) for recipe in recipes]
    baseline = {key: before for change in changes for key, (_, before) in change.items()}
    return [_join(baseline | {key: value for key, (value, _) in change.items()}) for change in changes]


def _join(settings: Mapping[str, Any]) -> str:
    names = [
        f"{key.rpartition('.')[2]} {short_repr(re.sub(r'[^ ]*/', '', format_value(key, value)), 30)}"
        for key, value in settings.items()
    ]
    return ", ".join(names[:_SETTINGS_NAMED]) + (", ..." if len(names) > _SETTINGS_NAMED else "")
