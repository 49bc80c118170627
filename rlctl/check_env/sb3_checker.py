"""Loads Stable-Baselines3's checker without torch, which the package imports and the checker never uses.

Importing torch takes most of a check's time and memory. So the modules that the checker needs are loaded without the
code of the packages that they are in, with classes that do nothing in torch's place; all of them are forgotten
afterwards, so that an environment that imports the library or torch gets the real one.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

_LIBRARY = "stable_baselines3"
_MODULE = f"{_LIBRARY}.common.env_checker"
_PACKAGES = (_LIBRARY, f"{_LIBRARY}.common")


def load_sb3_checker() -> Callable[[Any], None]:
    """Return SB3's `check_env`; raises what importing it raises."""
    if not {"torch", _LIBRARY} & sys.modules.keys():
        with contextlib.suppress(Exception), _without_torch():  # a version of it may need more than there is
            return _check_env()
    return _check_env()


def _check_env() -> Callable[[Any], None]:
    check_env: Callable[[Any], None] = importlib.import_module(_MODULE).check_env
    return check_env


@contextlib.contextmanager
def _without_torch() -> Iterator[None]:
    spec, finder = importlib.util.find_spec(_LIBRARY), _Finder()
    if spec is None or spec.origin is None:
        raise ImportError(f"no {_LIBRARY}")
    folder = Path(spec.origin).parent
    sys.meta_path.insert(0, finder)
    try:
        for name, path in zip(_PACKAGES, (folder, folder / "common"), strict=True):
            sys.modules[name] = _package(name, path)
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in [name for name in sys.modules if name.partition(".")[0] in ("torch", _LIBRARY)]:
            del sys.modules[name]


def _package(name: str, folder: Path) -> ModuleType:
    module = ModuleType(name)
    module.__path__ = [str(folder)]
    return module


class _Finder(MetaPathFinder, Loader):
    """Finds every module of torch, with whatever somebody imports from it."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self, is_package=True) if fullname.partition(".")[0] == "torch" else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Anything(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


class _Type(type):
    """A class with whatever attribute is asked for, for annotations and base classes."""

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return cls

    def __or__(cls, other: Any) -> Any:
        return cls

    __ror__ = __or__

    def __call__(cls, *arguments: Any, **keywords: Any) -> Any:
        return cls

    def __getitem__(cls, key: Any) -> Any:
        return cls


class _Nothing(metaclass=_Type):
    pass


class _Anything(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Nothing
