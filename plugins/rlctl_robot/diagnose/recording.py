"""Reads what `rlctl serve --rerun FILE` recorded: a row per answer to a client."""

import collections
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.errors import ArtifactError, short_repr
from rlctl.storage import untrusted
from rlctl_robot.diagnose.signals import Array
from rlctl_robot.diagnose.table import LogTable, check_finite

_ENTITY = re.compile(r"/client_(\d+)/(action|episode|limited|observation/.+)")
_LIMITED = "limited"
_NUMBERS, _TIME = "Scalars:scalars", "time"
_LARGEST = 512 * 2**20  # [bytes], of a file, which is read as a whole

_Rows = dict[int, Array]  # numbers by time [ns]


def read_recording(path: Path) -> LogTable:
    """Return the columns `time`, `episode`, `action_0`, .. and NAME_0, .. of each observation, client by client.

    `limited`, of the table, has the rows in which the server held the robot or changed the policy's action.

    Raises `ArtifactError` for a file that is no such recording.
    """
    with untrusted.open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
    if size > _LARGEST:
        raise ArtifactError(f"{path}: {size:,} bytes, the limit is {_LARGEST:,}; record a shorter time")
    clients = _read_clients(path)
    parts = [part for number in sorted(clients) if (part := _join(path, clients[number])) is not None]
    if not parts:
        raise ArtifactError(
            f"{path}: no actions with observations in it; diagnose reads what `rlctl serve --rerun` writes"
        )
    if any(part.keys() != parts[0].keys() for part in parts):
        raise ArtifactError(f"{path}: its clients had policies with other observations; record one policy per file")
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    lengths = tuple(len(part["time"]) for part in parts)
    limited = columns.pop(_LIMITED, None)
    rows = np.arange(sum(lengths))
    check_finite(path, rows, columns)
    return LogTable(path, columns, rows, lengths, "row", has_row_per_action=True, limited=limited)


def _read_clients(path: Path) -> dict[int, dict[str, _Rows]]:
    """Return the numbers of each entity of each client."""
    from rerun.chunk import RrdReader  # takes a second

    clients: dict[int, dict[str, _Rows]] = collections.defaultdict(lambda: collections.defaultdict(dict))
    try:
        for chunk in RrdReader(path).stream().filter(content="/**", has_timeline=_TIME, components=_NUMBERS):
            if match := _ENTITY.fullmatch(str(chunk.entity_path)):
                clients[int(match[1])][match[2]] |= _read_chunk(chunk.to_record_batch())
    except (RuntimeError, ValueError) as error:  # what Rerun raises for a damaged file
        raise ArtifactError(f"{path}: damaged, or no Rerun recording: {short_repr(str(error), 200)}") from None
    return clients


def _read_chunk(batch: Any) -> _Rows:
    times = batch.column(_TIME).to_numpy(zero_copy_only=False).astype("datetime64[ns]").astype(np.int64)
    values = batch.column(_NUMBERS)
    ends = values.offsets.to_numpy()
    flat = values.flatten().to_numpy(zero_copy_only=False)
    flat, ends = flat[: ends[-1] - ends[0]], ends - ends[0]
    return {int(at): flat[begin:end] for at, begin, end in zip(times, ends[:-1], ends[1:], strict=True)}


def _join(path: Path, entities: dict[str, _Rows]) -> dict[str, Array] | None:
    """Return the columns of the rows that have an action and all observations; None if there are none."""
    names = [name for name in entities if name.startswith("observation/")]
    if not names or "action" not in entities or "episode" not in entities:
        return None
    of_rows = ["action", "episode", *([_LIMITED] if _LIMITED in entities else [])]  # old recordings have no `limited`
    times = sorted(set.intersection(*(set(entities[name]) for name in [*names, *of_rows])))
    if not times:
        return None
    columns = {"time": (np.array(times) - times[0]) / 1e9}
    for name in [*of_rows, *names]:
        rows = [entities[name][at] for at in times]
        if len({len(row) for row in rows}) > 1:
            raise ArtifactError(f"{path}: {name} changes its size")
        label, values = name.removeprefix("observation/"), np.array(rows, np.float64)
        columns |= {
            label if name in ("episode", _LIMITED) else f"{label}_{index}": column
            for index, column in enumerate(values.T)
        }
    return columns
