"""Reads the tables of LeRobot datasets, formats v3.0 (many episodes in a file) and v2.1 (one); no images, no videos."""

import dataclasses
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ArtifactError, UsageError, describe_exception, explain_missing_package
from rlctl.storage import untrusted

_INFO = "meta/info.json"
EPISODE, FRAME, TIMESTAMP = "episode_index", "frame_index", "timestamp"
"""Columns that every dataset has: the number of the episode, the row in it, and its time [s]."""
_PICTURES = ("image", "video")
_DAMAGED = (OSError, ValueError, LookupError, TypeError, AttributeError, NotImplementedError, RuntimeError)
"""What reading a damaged table raises: pyarrow's errors are of these kinds."""


@dataclasses.dataclass(frozen=True)
class Feature:
    """What `meta/info.json` says about a column."""

    name: str
    dtype: str
    shape: tuple[int, ...]  # of a row; (1,) of a number
    element_names: tuple[str, ...]  # such as `shoulder_pan.pos`; empty if they are not given

    @property
    def is_picture(self) -> bool:
        """Whether the column has images, or a video beside the table has them."""
        return self.dtype in _PICTURES

    @property
    def size(self) -> int:
        """Count of numbers in a row."""
        return math.prod(self.shape)


def is_lerobot_dataset(folder: Path) -> bool:
    """Return whether a folder has what each LeRobot dataset has, `meta/info.json`."""
    return (folder / _INFO).is_file()


def read_features(folder: Path) -> dict[str, Feature]:
    """Return the columns of a dataset by their names; raises `ArtifactError` for a folder that is no dataset."""
    path = folder / _INFO
    content = untrusted.read_bytes(path, untrusted.JSON_LIMIT)
    try:
        described = untrusted.parse_json(content)["features"]
        return {name: _read_feature(name, feature) for name, feature in described.items()}
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise ArtifactError(f"{path}: damaged, or not of a LeRobot dataset: {describe_exception(error)}") from None


def _read_feature(name: str, described: dict[str, Any]) -> Feature:
    shape = tuple(int(size) for size in described["shape"])
    if min(shape, default=0) < 0:
        raise ValueError(f"feature {name} has the shape {list(shape)}")
    return Feature(name, str(described["dtype"]), shape, _list_names(described.get("names")))


def _list_names(names: Any) -> tuple[str, ...]:
    """Return the names of elements: a list, or lists by a word such as `motors` (older datasets)."""
    if isinstance(names, dict):
        lists = [part for part in names.values() if isinstance(part, list)]
        return tuple(str(name) for part in lists for name in part)
    return tuple(str(name) for name in names or ())


def read_rows(folder: Path, features: Collection[Feature], user: str) -> dict[str, NDArray[Any]]:
    """Return the rows of columns, shape (T, *shape) each, by the number of their episode and in its order.

    `episode_index`, shape (T,), is among them. `user` is the command that needs the package. Raises `UsageError` if
    pyarrow is not installed, and `ArtifactError` for damaged tables and rows of other sizes than `meta/info.json` says.
    """
    try:
        import pyarrow
        from pyarrow import types
    except ImportError as error:
        raise UsageError(explain_missing_package(user, error.name, "demos")) from None
    files = sorted(folder.glob("data/*/*.parquet"))
    if not files:
        raise ArtifactError(f"{folder}: no tables in it (data/*/*.parquet)")
    names = list(dict.fromkeys([EPISODE, FRAME, *(feature.name for feature in features)]))
    row_bytes = 8 * (2 + sum(feature.size for feature in features))
    try:
        tables = [_read_table(file, names, row_bytes) for file in files]
        table = pyarrow.concat_tables(tables).sort_by([(EPISODE, "ascending"), (FRAME, "ascending")])
        if not types.is_integer(table[EPISODE].type):
            raise ValueError(f"{EPISODE} has no numbers")
        rows = {EPISODE: table[EPISODE].to_numpy()}
        for feature in features:
            rows[feature.name] = _to_array(table[feature.name], feature)
    except _DAMAGED as error:
        raise ArtifactError(f"{folder}: damaged, or not a dataset: {describe_exception(error)}") from None
    return rows


def _read_table(file: Path, names: list[str], row_bytes: int) -> Any:
    from pyarrow import parquet

    with untrusted.open_file(file) as opened:
        table = parquet.ParquetFile(opened)
        missing = set(names) - set(table.schema_arrow.names)
        if missing:
            raise ValueError(f"{file.name} has no column {min(missing)!r}")
        untrusted.check_size(file, table.metadata.num_rows * row_bytes, "unpacked ")
        return table.read(columns=names)


def _to_array(column: Any, feature: Feature) -> NDArray[Any]:
    from pyarrow import compute, types

    values = column.combine_chunks()
    while types.is_list(values.type) or types.is_large_list(values.type) or types.is_fixed_size_list(values.type):
        if values.null_count:
            raise ValueError(f"{feature.name} has rows without a value")
        sizes = np.unique(compute.list_value_length(values).to_numpy(zero_copy_only=False))
        if len(sizes) > 1:
            raise ValueError(f"{feature.name} has rows of {int(sizes[0])} and of {sizes[-1]} numbers")
        values = values.flatten()
    numbers = values.to_numpy(zero_copy_only=False)
    if len(numbers) != len(column) * feature.size:
        width = len(numbers) / len(column)
        raise ValueError(f"{feature.name} has {width:g} numbers in a row, and {feature.size} in {_INFO}")
    return numbers.reshape(len(column), *feature.shape)
