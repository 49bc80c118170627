"""The replay buffer on disk: segments of transitions, each written once.

A full buffer is too large to write at every checkpoint. Transitions are numbered in the order of the steps; a step of
all environments is one transition. A segment holds a range of them, and a checkpoint lists the segments of the buffer,
oldest first. Where two overlap the later one is valid. Segments that no checkpoint lists are removed.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from rlctl.environments.dict_spaces import split
from rlctl.errors import ArtifactError
from rlctl.storage import files
from rlctl.training.snapshot import Tensors

SEGMENT_BYTES = 8 * 2**20  # size of a segment [bytes]; the last one is written again until it has this size
_FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Segment(pydantic.BaseModel):
    """The transitions from `first` to `last` - 1, in a file."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    first: int = pydantic.Field(ge=0, lt=10**12)
    last: int = pydantic.Field(gt=0, lt=10**12)
    sha256: str

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.first:012d}-{self.last:012d}.safetensors"


class ReplaySegments:
    """Writes a replay buffer into a folder, segment by segment, and reads it again."""

    def __init__(self, folder: Path, buffer: ReplayBuffer) -> None:
        self.folder = folder
        self.buffer = buffer
        self._segments: list[Segment] = []
        self._written = 0
        self._most_rows = max(1, SEGMENT_BYTES // sum(array[:1].nbytes for array in _arrays(buffer).values()))

    def mark_last_changed(self, added: int) -> None:
        """Note that the last of `added` transitions was changed after it was added."""
        self._written = min(self._written, added - 1)

    def save(self, added: int) -> list[Segment]:
        """Write new transitions, of `added` in total; return the segments of the buffer."""
        oldest = max(0, added - self.buffer.buffer_size)
        segments = [segment for segment in self._segments if segment.last > oldest]
        if not all((self.folder / segment.name).exists() for segment in segments):  # some were removed
            segments, self._written = [], 0
        rows = self._most_rows
        first = max(self._written // rows * rows, oldest)
        segments = [segment for segment in segments if segment.first < first]
        segments += [self._write(low, min(low + rows, added)) for low in range(first, added, rows)]
        self._segments, self._written = segments, added
        return list(segments)

    def _write(self, first: int, last: int) -> Segment:
        indices = np.arange(first, last) % self.buffer.buffer_size
        content = save_tensors({name: array[indices] for name, array in _arrays(self.buffer).items()})
        segment = Segment(first=first, last=last, sha256=files.digest(content))
        files.write_bytes(self.folder / segment.name, content)
        return segment

    def load(self, segments: Sequence[Segment], added: int) -> None:
        """Fill the buffer with the last of `added` transitions; raises `ArtifactError` if they do not fit it."""
        buffer = self.buffer
        reached = max(0, added - buffer.buffer_size)
        for segment in segments:
            if segment.first > reached:
                break
            self._read(segment)
            reached = max(reached, segment.last)
        if reached != added:
            raise ArtifactError(f"{self.folder}: transitions after number {reached} are missing, of {added}")
        buffer.pos, buffer.full = added % buffer.buffer_size, added >= buffer.buffer_size
        self._segments, self._written = list(segments), added

    def remove_others(self, named: Iterable[Segment]) -> None:
        """Remove the segments that no checkpoint names."""
        names = {segment.name for segment in named}
        for file in self.folder.glob("*.safetensors"):
            if file.name not in names:
                files.remove(file)

    def _read(self, segment: Segment) -> None:
        file = self.folder / segment.name
        indices = np.arange(segment.first, segment.last) % self.buffer.buffer_size
        try:
            stored = load_tensors(file.read_bytes())
            for name, array in _arrays(self.buffer).items():
                array[indices] = stored[name]
        except (OSError, KeyError, ValueError) as error:
            raise ArtifactError(f"{file}: does not fit this recipe: {error}") from None


def _arrays(buffer: ReplayBuffer) -> Tensors:
    arrays: Tensors = {}
    for name in _FIELDS:
        value: Any = getattr(buffer, name)
        arrays |= {f"{name}/{key}": part for key, part in split(value).items()}
    return arrays


def hindsight_tensors(buffer: ReplayBuffer) -> Tensors:
    """Return the positions of the episodes in a HER buffer; empty for other buffers."""
    if not isinstance(buffer, HerReplayBuffer):
        return {}
    return {
        "hindsight/start": buffer.ep_start,
        "hindsight/length": buffer.ep_length,
        "hindsight/running": buffer._current_ep_start,
    }


def restore_hindsight(buffer: ReplayBuffer, tensors: Tensors) -> None:
    """Restore the positions of episodes that `hindsight_tensors` returned."""
    if isinstance(buffer, HerReplayBuffer):
        for name, array in hindsight_tensors(buffer).items():
            array[...] = tensors[name]
