"""Files of the current folder that are installed too: findings are shown there, and an outdated installation is noted.

`pip install .` copies a package; Python then imports the copy, wherever a command is run.
"""

import itertools
import re
from collections.abc import Iterator
from pathlib import Path

_INSTALLED = re.compile(r"^.*/(?:site|dist)-packages/")
_LAYOUTS = ("", "src/", "*/", "*/src/", "*/*/src/")
"""Where a package may be below the current folder, the likeliest first."""
_NO_SOURCES = {"site-packages", "dist-packages", "build"}
_MOST_FILES = 400  # of a package that are compared


def prefer_working_copy(file: Path) -> Path:
    """Return the file of the current folder of which an imported file is an equal copy; else the imported file."""
    copy = find_working_copy(file)
    return copy if copy is not None and _read(copy) == _read(file) else file


def find_working_copy(file: Path) -> Path | None:
    """Return the file of the current folder that has the module path of a file from elsewhere; None if none has."""
    here = Path.cwd()
    if is_own(file):
        return None
    name = file.relative_to(find_root(file)).as_posix()
    found = itertools.chain.from_iterable(sorted(here.glob(layout + name)) for layout in _LAYOUTS)
    return next((copy for copy in found if not _NO_SOURCES & {*copy.relative_to(here).parts}), None)


def is_own(file: Path) -> bool:
    """Return whether a file is of the current folder, and not in a virtual environment there."""
    return file.resolve().is_relative_to(Path.cwd().resolve()) and not _INSTALLED.match(file.as_posix())


def find_outdated(file: Path) -> tuple[Path, Path] | None:
    """Return an imported file and the file of the current folder that should be equal; None if there is no such pair.

    `file` is of the package that is compared, module by module; a file without a package is compared alone.
    """
    copy = find_working_copy(file)
    if copy is None:
        return None
    package, own = file, copy
    while (package.parent / "__init__.py").is_file() and package.parent.name == own.parent.name:
        package, own = package.parent, own.parent
    pairs = ((each, own / each.relative_to(package)) for each in _list_modules(package))
    return next((pair for pair in pairs if pair[1].is_file() and _read(pair[0]) != _read(pair[1])), None)


def _list_modules(package: Path) -> Iterator[Path]:
    return itertools.islice(sorted(package.rglob("*.py")), _MOST_FILES) if package.is_dir() else iter([package])


def find_root(file: Path) -> Path:
    """Return the folder from which a file is imported: `site-packages`, or the one that has its outermost package."""
    if installed := _INSTALLED.match(file.as_posix()):
        return Path(installed[0])
    folder = file.parent
    while (folder / "__init__.py").is_file():
        folder = folder.parent
    return folder


def _read(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except OSError:
        return None
