"""Checkpoints: everything that a bit-exact resume needs, without pickle.

A checkpoint is a folder with `policy.safetensors` (a policy file), `state.safetensors` (optimisers, generators,
statistics, the actions of running episodes) and `state.json` (plain data, and each file's sha256), written atomically.
The replay buffer of an off-policy algorithm, too large to be written each time, is in parts next to the folders. Its
transitions are numbered in the order of the steps; a step of all environments is one. A checkpoint lists the parts,
oldest first; where two overlap the later one is valid.
"""

import contextlib
import dataclasses
import json
import platform
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
import torch
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from rlctl.environments.dict_spaces import split
from rlctl.errors import ArtifactError
from rlctl.policy.file import PolicyFile
from rlctl.runs.directory import RunDirectory
from rlctl.storage import files
from rlctl.training.progress import Progress
from rlctl.training.rollouts import WorkerVecEnv
from rlctl.training.snapshot import Tensors
from rlctl.training.stacked_replay import StackedRows
from rlctl.version import collect_versions

FORMAT = 1
PART_BYTES = 8 * 2**20  # size of a part [bytes]; the last one is written again until it has this size
_FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_POLICY, _STATE, _TENSORS = "policy.safetensors", "state.json", "state.safetensors"


class ReplayPart(pydantic.BaseModel):
    """The transitions from `first` to `last` - 1, in a file."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    first: int = pydantic.Field(ge=0, lt=10**12)
    last: int = pydantic.Field(gt=0, lt=10**12)
    sha256: str

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.first:012d}-{self.last:012d}.safetensors"


class State(pydantic.BaseModel):
    """The content of `state.json`."""

    format: int = FORMAT
    run: str = ""  # the `id` of its run
    step: int
    model: dict[str, Any]  # plain data of `snapshot.take`
    progress: Progress
    callbacks: list[dict[str, Any]] = []  # plain data of `Callbacks.take`
    segments: list[ReplayPart] = []  # the files of the replay buffer
    computed_with: dict[str, str]  # what bit-exact results depend on: versions, processor, threads
    sha256: dict[str, str] = {}


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that was read and is undamaged."""

    folder: Path
    state: State
    tensors: Tensors = dataclasses.field(repr=False)


def write(path: Path, state: State, policy: PolicyFile, tensors: Tensors) -> None:
    """Write the folder of a checkpoint, whose `state` gets the digests; raises `OSError` if it cannot be written."""
    contents = {
        _POLICY: policy.encode(),
        _TENSORS: save_tensors({name: np.asarray(value, order="C") for name, value in tensors.items()}),
    }
    state.sha256 = {name: files.digest(content) for name, content in contents.items()}
    plain_state = state.model_dump(mode="json")
    contents[_STATE] = json.dumps({"sha256": _seal(plain_state), "state": plain_state}).encode()
    with files.whole_folder(path) as folder:
        for name, content in contents.items():
            files.write_new(folder / name, content)


def read_newest(run: RunDirectory) -> tuple[Checkpoint | None, list[str]]:
    """Return the newest undamaged checkpoint, if any, and the problems of newer ones; raises if all are damaged."""
    damage: list[str] = []
    for folder in reversed(run.checkpoints()):
        try:
            checkpoint = read(folder)
            if checkpoint.state.run != run.id():
                raise ArtifactError(f"{folder}: this checkpoint belongs to another run and is not used")
            return checkpoint, damage
        except ArtifactError as error:
            damage.append(str(error))
    if damage:
        raise ArtifactError(f"{damage[0]}\nno checkpoint of {run.path} can be read; start a new training")
    return None, []


def read(folder: Path) -> Checkpoint:
    """Read and verify a checkpoint; raises `ArtifactError` if a file is missing, damaged or not a checkpoint's."""
    state = _read_state(folder)
    for name in (_POLICY, _TENSORS):
        files.check_digest(folder / name, state.sha256.get(name, ""))
    for part in state.segments:
        files.check_digest(folder.parent / "replay" / part.name, part.sha256)
    return Checkpoint(folder, state, load_tensors((folder / _TENSORS).read_bytes()))


def _read_state(folder: Path) -> State:
    file = folder / _STATE
    sealed = files.read_json(file)
    try:
        content = sealed["state"]
        if (version := content["format"]) > FORMAT:
            raise ArtifactError(f"{file}: checkpoint format {version} is newer than this rlctl reads ({FORMAT})")
        if sealed["sha256"] != _seal(content):
            raise ArtifactError(f"{file}: damaged: its content does not match its sha256")
        state = State.model_validate(content)
    except (TypeError, LookupError, pydantic.ValidationError):
        raise ArtifactError(f"{file}: damaged, or not a checkpoint of rlctl") from None
    if state.step != int(folder.name):
        raise ArtifactError(f"{folder}: the folder's name is wrong: it holds the checkpoint of step {state.step}")
    return state


def _seal(state: Any) -> str:
    return files.digest(json.dumps(state, sort_keys=True).encode())


def list_replay_parts(run: RunDirectory) -> list[ReplayPart]:
    """Return the parts of replay buffers that a run's checkpoints name."""
    named: list[ReplayPart] = []
    for folder in run.checkpoints():
        with contextlib.suppress(ArtifactError):  # a damaged checkpoint needs no parts any more
            named += _read_state(folder).segments
    return named


def describe_computation(device: torch.device) -> dict[str, str]:
    """Return what bit-exact results of a training depend on."""
    return {
        **collect_versions(),
        "machine": platform.machine(),
        "processor": f"{_cpu_vendor()} {torch.backends.cpu.get_cpu_capability()}",
        "threads": str(torch.get_num_threads()),
        "device": str(device),
    }


def _cpu_vendor() -> str:
    """Return the processor's vendor if known: libraries choose their code by it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    vendors = (line.partition(":")[2].strip() for line in lines if line.startswith(("vendor_id", "CPU implementer")))
    return next(vendors, "unknown")


def find_differences(before: dict[str, str], now: dict[str, str]) -> list[str]:
    """Return `torch 2.13.0 -> 2.14.0` for each entry that has changed."""
    pairs = {name: (before.get(name, "none"), now.get(name, "none")) for name in [*before, *now]}
    return [f"{name} {old} -> {new}" for name, (old, new) in pairs.items() if old != new]


def environment_tensors(env: WorkerVecEnv) -> Tensors:
    """Return the numbers, actions and last observations of the running episodes."""
    histories = [env.join_actions(index) for index in range(env.num_envs)]
    last = env.last_observations()
    return {
        "environments/episodes_started": np.array(env.episodes_started, np.int64),
        "environments/level": env.levels,
        "environments/limit": env.limits,
        "environments/steps": np.array([len(actions) for actions in histories], np.int64),
        "environments/actions": np.concatenate(histories),
        **{f"environments/observation/{key}": observation for key, observation in last.items()},
    }


def restore_environments(env: WorkerVecEnv, tensors: Tensors) -> str | None:
    """Repeat the actions of the running episodes; return a message if one does not reach its saved state."""
    steps = tensors["environments/steps"].tolist()
    if len(steps) != env.num_envs:
        raise ArtifactError(f"it was saved with {len(steps)} environments, not {env.num_envs}")
    env.levels = tensors["environments/level"]
    env.limits = tensors.get("environments/limit", np.zeros(env.num_envs, np.int64))  # older ones have none
    started = tensors["environments/episodes_started"].tolist()
    mismatch = set(env.begin_episodes(started, np.split(tensors["environments/actions"], np.cumsum(steps)[:-1])))
    for key, observation in env.workers.arrays.observation.items():
        before = tensors[f"environments/observation/{key}"]
        mismatch.update(index for index in range(env.num_envs) if not np.array_equal(before[index], observation[index]))
    if not mismatch:
        return None
    return (
        f"environment {min(mismatch)} did not reach its saved state from its seed and actions, "
        "so all environments start new episodes"
    )


class ReplayParts:
    """Writes a replay buffer into a folder, part by part, and reads it again."""

    def __init__(self, folder: Path, buffer: ReplayBuffer) -> None:
        self.folder = folder
        self.buffer = buffer
        self._parts: list[ReplayPart] = []
        self._written = 0
        self._most_rows = max(1, PART_BYTES // sum(array[:1].nbytes for array in _arrays(buffer).values()))

    def mark_last_changed(self, added: int) -> None:
        """Note that the last of `added` transitions was changed after it was added."""
        self._written = min(self._written, added - 1)

    def save(self, added: int) -> list[ReplayPart]:
        """Write new transitions, of `added` in total; return the parts of the buffer."""
        oldest = max(0, added - self.buffer.buffer_size)
        parts = [part for part in self._parts if part.last > oldest]
        if not all((self.folder / part.name).exists() for part in parts):  # some were removed
            parts, self._written = [], 0
        rows = self._most_rows
        first = max(self._written // rows * rows, oldest)
        parts = [part for part in parts if part.first < first]
        parts += [self._write(low, min(low + rows, added)) for low in range(first, added, rows)]
        self._parts, self._written = parts, added
        return list(parts)

    def _write(self, first: int, last: int) -> ReplayPart:
        indices = np.arange(first, last) % self.buffer.buffer_size
        content = save_tensors({name: array[indices] for name, array in _arrays(self.buffer).items()})
        part = ReplayPart(first=first, last=last, sha256=files.digest(content))
        files.write_bytes(self.folder / part.name, content)
        return part

    def load(self, parts: Sequence[ReplayPart], added: int) -> None:
        """Fill the buffer with the last of `added` transitions; raises `ArtifactError` if they do not fit it."""
        buffer = self.buffer
        stacks = buffer.observations.stacks if isinstance(buffer.observations, StackedRows) else None
        if stacks is not None:
            stacks.added = added
        reached = max(0, added - buffer.buffer_size)
        for part in parts:
            if part.first > reached:
                break
            self._read(part)
            reached = max(reached, part.last)
        if reached != added:
            raise ArtifactError(f"{self.folder}: transitions after number {reached} are missing, of {added}")
        if stacks is not None:
            stacks.finish_loading()
        buffer.pos, buffer.full = added % buffer.buffer_size, added >= buffer.buffer_size
        self._parts, self._written = list(parts), added

    def remove_others(self, named: Iterable[ReplayPart]) -> None:
        """Remove the parts that no checkpoint names."""
        names = {part.name for part in named}
        for file in self.folder.glob("*.safetensors"):
            if file.name not in names:
                files.remove(file)

    def _read(self, part: ReplayPart) -> None:
        file = self.folder / part.name
        indices = np.arange(part.first, part.last) % self.buffer.buffer_size
        try:
            stored = load_tensors(file.read_bytes())
            for name, array in _arrays(self.buffer).items():
                array[indices] = stored[name]
        except (OSError, KeyError, ValueError) as error:
            raise ArtifactError(f"{file}: does not fit this recipe: {error}") from None


def _arrays(buffer: ReplayBuffer) -> Tensors:
    return {f"{name}/{key}": part for name in _FIELDS for key, part in split(getattr(buffer, name)).items()}


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
    for name, array in hindsight_tensors(buffer).items():
        array[...] = tensors[name]
