"""Reads LeRobot datasets as logs: a column per number of their features, episode after episode."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from rlctl.errors import ArtifactError
from rlctl.storage import lerobot
from rlctl.storage.lerobot import Feature
from rlctl_robot.diagnose.signals import Array
from rlctl_robot.diagnose.table import LogTable, TableHeader, check_finite, check_width, choose_windows

_NUMBERS = ("float", "int", "uint", "bool")  # how the names of their types begin


def read_dataset_header(folder: Path) -> TableHeader:
    """Return the names of the columns: `action.shoulder_pan.pos` where elements have names, else `action_0`.

    Raises `ArtifactError` for features whose names do not fit their sizes.
    """
    names = [name for feature in _list_features(folder) for name in _name_columns(folder, feature)]
    return TableHeader(folder, tuple(names))


def read_dataset(folder: Path, used: Collection[str]) -> LogTable:
    """Read the `used` columns; raises `ArtifactError` for damaged tables and for what is not a finite number."""
    columns_of = {feature: _name_columns(folder, feature) for feature in _list_features(folder)}
    wanted = [feature for feature, names in columns_of.items() if any(name in used for name in names)]
    rows = lerobot.read_rows(folder, wanted, f"diagnose {folder}")
    count = len(rows[lerobot.EPISODE])
    starts, length = choose_windows(count)
    chosen = (np.array(starts)[:, None] + np.arange(length)).ravel()
    columns: dict[str, Array] = {}
    for feature in wanted:
        values = rows[feature.name][chosen].reshape(len(chosen), -1).astype(np.float64)
        columns |= {name: values[:, index] for index, name in enumerate(columns_of[feature]) if name in used}
    check_finite(folder, chosen, columns)
    note = f"{folder}: {len(starts)} parts of {length} of {count:,} rows are read" if len(starts) > 1 else ""
    return LogTable(folder, columns, chosen, (length,) * len(starts), "row", note)


def _list_features(folder: Path) -> list[Feature]:
    features = lerobot.read_features(folder).values()
    numeric = [feature for feature in features if feature.dtype.startswith(_NUMBERS)]
    check_width(folder, sum(feature.size for feature in numeric))
    return numeric


def _name_columns(folder: Path, feature: Feature) -> list[str]:
    names = feature.element_names
    if feature.size == 1:
        return [feature.name]
    if not names:
        return [f"{feature.name}_{index}" for index in range(feature.size)]
    if len(names) != feature.size or len(set(names)) != len(names):
        raise ArtifactError(
            f"{folder}/meta/info.json: {feature.name} has {feature.size} numbers and {len(set(names))} different "
            "names; give each a name, or none"
        )
    return [f"{feature.name}.{name}" for name in names]
