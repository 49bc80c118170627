"""Hides the packages that `HIDE_PACKAGES` names: with this folder in `PYTHONPATH` no Python process finds them."""

import os
from importlib.machinery import PathFinder

_HIDDEN = frozenset(os.environ.get("HIDE_PACKAGES", "").split())
_find_spec = PathFinder.find_spec


def _find_what_is_not_hidden(cls, name, path=None, target=None):
    return None if name.partition(".")[0] in _HIDDEN else _find_spec(name, path, target)


PathFinder.find_spec = classmethod(_find_what_is_not_hidden)
