"""The two timelines of a recording: `step` and, where the time between two steps is known, `sim_time`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray


class Timelines:
    """Sends whole columns: one call per entity is a hundred times faster than one per row."""

    def __init__(self, stream: rr.RecordingStream, dt: float | None) -> None:
        self.stream = stream
        self.dt = dt

    @property
    def default(self) -> str:
        """The timeline that the viewer opens with."""
        return "step" if self.dt is None else "sim_time"

    def send(
        self, entity: str, steps: Sequence[int] | NDArray[np.int64], columns: Iterable[rr.ComponentColumn]
    ) -> None:
        """Send a row per element of `steps` to an entity."""
        if len(steps) == 0:
            return
        sequence = np.asarray(steps, np.int64)
        indexes = [rr.TimeColumn("step", sequence=sequence)]
        if self.dt is not None:
            # Floating-point times are cut off by Rerun, not rounded: two rows a nanosecond apart would result.
            nanoseconds = np.round(sequence * self.dt * 1e9).astype("timedelta64[ns]")
            indexes.append(rr.TimeColumn("sim_time", duration=nanoseconds))
        self.stream.send_columns(entity, indexes, columns)
