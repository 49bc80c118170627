"""Reads recordings back."""

from pathlib import Path

import numpy as np


def reader(path: Path):
    """Open a recording: importing what reads it takes half a second."""
    from rerun.chunk import RrdReader

    return RrdReader(path)


def chunks(path: Path, entity: str, component: str):
    """Yield the record batches of an entity that hold a component."""
    for chunk in reader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            yield batch


def column(path: Path, entity: str, component: str = "Scalars:scalars", timeline: str = "step"):
    """Return times of shape (rows,) and values of shape (rows, ...), in the order of time."""
    rows = sorted(_rows(path, entity, component, timeline), key=lambda row: row[0])
    return np.array([time for time, _ in rows]), np.array([value for _, value in rows])


def jpegs(path: Path, entity: str) -> dict[int, bytes]:
    """Return the pictures of an entity by step."""
    return {step: bytes(blob[0]) for step, blob in _rows(path, entity, "EncodedImage:blob", "step")}


def _rows(path: Path, entity: str, component: str, timeline: str):
    for batch in chunks(path, entity, component):
        if timeline in batch.schema.names:
            times = batch.column(timeline).to_numpy(zero_copy_only=False).tolist()
            yield from zip(times, batch.column(component).to_pylist(), strict=True)


def static(path: Path, entity: str, component: str):
    """Return the values of a static component."""
    (batch,) = chunks(path, entity, component)
    return batch.column(component).to_pylist()[0]


def layout(path: Path, component: str, entity: str = "/") -> list:
    """Return the values of a component in a recording's layout, below an entity."""
    found = []
    for store in reader(path).blueprints():
        for chunk in reader(path).stream(store=store):
            batch = chunk.to_record_batch()
            if component in batch.schema.names and chunk.entity_path.startswith(entity):
                found += batch.column(component).to_pylist()[0] or []
    return found


def properties(path: Path) -> dict:
    found = {}
    for chunk in reader(path).stream().filter(content="/__properties/episode"):
        batch = chunk.to_record_batch()
        found.update({name: batch.column(name)[0].as_py()[0] for name in batch.schema.names if "RowId" not in name})
    return found


def entities(path: Path) -> set[str]:
    return {str(entity) for entity in reader(path).store().schema().entity_paths()}
