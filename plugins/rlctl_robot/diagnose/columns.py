"""Which columns of a log are the elements of which observation or action: by name, or as a file says."""

import dataclasses
import difflib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError, check_name
from rlctl.exporting.controller.plan import ControllerPlan
from rlctl.storage import yaml_text
from rlctl.storage.validation import Number, Section
from rlctl_robot.diagnose.signals import ACTIONS, Array

JOINT_POSITIONS, JOINT_TARGETS = "joint_positions", "joint_targets"
_CLOSE = 0.72  # similarity of names, from 0 to 1
TIMES = ("time", "t", "timestamp", "stamp", "time_s")
EPISODES = ("episode", "segment", "trial", "episode_index")
_PREFIXES = ("observation_", "observations_", "obs_")
_SYNONYMS = {
    JOINT_POSITIONS: ("q", "qpos", "position", "positions", "joint_pos", "dof_pos", "joint_angles", "state"),
    "joint_velocities": ("dq", "qd", "qvel", "velocity", "velocities", "joint_vel", "dof_vel", "joint_speeds"),
    "angular_velocity": ("gyro", "gyroscope", "omega", "ang_vel", "base_ang_vel"),
    "gyroscope": ("gyro", "omega", "ang_vel", "base_ang_vel", "angular_velocity"),
    "velocity": ("lin_vel", "base_lin_vel", "linear_velocity"),
    "gravity": ("projected_gravity", "gravity_vector"),
    "attitude": ("rpy", "roll_pitch_yaw", "euler"),
    "command": ("commands", "cmd", "velocity_commands"),
    "last_action": ("last_actions", "prev_action", "previous_action"),
    ACTIONS: ("action", "act", "a", "policy_action"),
    JOINT_TARGETS: (
        *("target", "targets", "target_position", "target_positions", "command", "commands", "cmd", "goal", "desired"),
        *("q_des", "q_target", "des_dof_pos", "desired_position", "goal_position", "position_command", "action"),
        "actions",
    ),
}
_SUFFIXES = {3: (("x", "y", "z"), ("roll", "pitch", "yaw")), 4: (("x", "y", "z", "w"), ("qx", "qy", "qz", "qw"))}


class ColumnMap(Section):
    """The columns of a log, as `--columns FILE` gives them."""

    time: str | None = None
    """Column with the time [s]."""
    episode: str | None = None
    """Column with a number that changes where a new episode begins."""
    observations: dict[str, list[str]] = {}
    """Columns of each observation, in the policy's order of elements."""
    actions: list[str] = []
    """Columns of the action."""
    scale: dict[str, Number | list[Number]] = {}
    """Factor from the columns of an observation, or of `actions`, to the policy's unit; one, or one per element."""
    offset: dict[str, Number | list[Number]] = {}
    """Added after that, in the policy's unit."""


@dataclasses.dataclass(frozen=True)
class ColumnAssignment:
    """The column of each element."""

    observations: Mapping[str, tuple[str, ...]]  # in the policy's order
    actions: tuple[str, ...]
    time: str | None
    episode: str | None
    notes: tuple[str, ...]  # what was assigned other than by its exact name
    is_of_controller: bool = False  # whether the observations are the inputs of a controller
    units: Mapping[str, tuple[Array, Array]] = dataclasses.field(default_factory=dict)
    """Factor and offset from a column of an observation, or of `actions`, to the policy's unit, shape (n,) each."""

    def stack(self, columns: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return observations and actions in the policy's units, a row per row of the columns."""
        parts = {name: self._convert(name, names, columns) for name, names in self.observations.items()}
        return np.column_stack(list(parts.values())), self._convert(ACTIONS, self.actions, columns)

    def _convert(self, term: str, names: Sequence[str], columns: Mapping[str, Array]) -> Array:
        values = np.column_stack([columns[name] for name in names])
        if term not in self.units:
            return values
        scale, offset = self.units[term]
        converted: Array = scale * values + offset
        return converted

    @property
    def used(self) -> set[str]:
        """All columns that are read."""
        named = [*self.actions, *(name for names in self.observations.values() for name in names)]
        return {name for name in [*named, self.time, self.episode] if name is not None}


def assign_columns(path: Path, names: Sequence[str], info: EnvInfo, size: int, given: Path | None) -> ColumnAssignment:
    """Assign columns by their names, or as the file `given` says; `size` is of the whole observation.

    Raises `ArtifactError` if the columns of an observation or of the action cannot be decided.
    """
    terms = dict(info.observation_sizes) or {"observation": size}
    actions = _count_actions(info)
    column_map = ColumnMap() if given is None else yaml_text.read_model(given, ColumnMap)
    for name in column_map.observations:
        check_name(name, terms, f"{given}: the policy has no observation", ArtifactError)
    finder = ColumnFinder(path, names, info.joints.names if info.joints is not None else ())
    inputs = {} if column_map.observations else _find_inputs(finder, info, size)
    found: dict[str, tuple[str, ...]] = {}
    flat = None
    if not column_map.observations:
        flat = finder.find_indexed(("observation", "observations", "obs", "state"), size)
    if flat is not None:
        ends = iter(flat)
        found = {name: tuple(next(ends) for _ in range(count)) for name, count in terms.items()}
    if inputs and flat is None:
        found, terms = inputs, {}
        finder.notes.append(f"{path}: its columns are what an exported controller takes: {', '.join(inputs)}")
    for name, count in {**terms, ACTIONS: actions}.items():
        explicit = column_map.actions if name == ACTIONS else column_map.observations.get(name, [])
        if explicit:
            found[name] = finder.check(given or path, name, explicit, count)
        elif name not in found:
            found[name] = finder.find(name, count)
    refuse_shared(path, found)
    time = column_map.time or finder.find_one(TIMES)
    episode = column_map.episode or finder.find_one(EPISODES)
    for column in (column_map.time, column_map.episode):
        if column is not None:
            check_name(column, names, f"{given}: {path} has no column", ArtifactError)
    units = read_units(given, column_map, {name: len(columns) for name, columns in found.items()})
    chosen = found.pop(ACTIONS)
    is_of_controller = bool(inputs) and flat is None
    return ColumnAssignment(found, chosen, time, episode, tuple(finder.notes), is_of_controller, units)


def read_units(given: Path | None, column_map: ColumnMap, sizes: Mapping[str, int]) -> dict[str, tuple[Array, Array]]:
    """Return factor and offset of observations and actions, `sizes` elements each; raises `ArtifactError`."""
    units = {}
    for name in {**column_map.scale, **column_map.offset}:
        check_name(name, sizes, f"{given}: scale and offset are of observations and {ACTIONS}, not of", ArtifactError)
        numbers = []
        for key, values, default in (("scale", column_map.scale, 1.0), ("offset", column_map.offset, 0.0)):
            number = np.asarray(values.get(name, default), np.float64)
            if number.ndim and len(number) != sizes[name]:
                raise ArtifactError(f"{given}: {key}: {name} has {sizes[name]} elements, and {len(number)} are given")
            numbers.append(np.broadcast_to(number, sizes[name]))
        scale, offset = numbers
        units[name] = (scale, offset)
    return units


def _find_inputs(finder: "ColumnFinder", info: EnvInfo, size: int) -> dict[str, tuple[str, ...]]:
    """Return the columns of a controller's inputs; empty unless all are there and a computed term is not."""
    sizes = info.observation_sizes
    computed = [name for name, term in info.observation_terms.items() if name not in term.inputs and name in sizes]
    if sum(sizes.values()) != size or all(finder.find_exact(name, sizes[name]) for name in computed):
        return {}
    columns = {part.name: finder.find_exact(part.name, part.size) for part in ControllerPlan(info).quantities}
    return {name: some for name, some in columns.items() if some} if all(columns.values()) else {}


def _count_actions(info: EnvInfo) -> int:
    shape = info.spaces()[1].shape or ()
    return int(shape[0]) if shape else 1


def refuse_shared(path: Path, found: Mapping[str, Sequence[str]]) -> None:
    """Raise `ArtifactError` if two terms have the same column."""
    owner: dict[str, str] = {}
    for name, columns in found.items():
        for column in columns:
            if column in owner:
                raise ArtifactError(
                    f"{path}: column {column!r} fits {owner[column]} and {name}; say which it is: --columns FILE"
                )
            owner[column] = name


def _simplify(name: str) -> str:
    text = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    for prefix in _PREFIXES:
        if text.startswith(prefix) and not text.removeprefix(prefix).isdigit():
            text = text.removeprefix(prefix)
    return text


class ColumnFinder:
    """Finds the columns of quantities by their names: exact ones, those of `_SYNONYMS`, and close ones."""

    def __init__(self, path: Path, names: Sequence[str], joints: Sequence[str]) -> None:
        """`names` are those of all columns, `joints` those of the robot, with which columns may end."""
        self._path, self._joints = path, joints
        self._by_text = {_simplify(name): name for name in names}
        self._names = names
        self.notes: list[str] = []

    def find_one(self, texts: Sequence[str]) -> str | None:
        """Return the first column with one of the names; None if there is none."""
        return next((self._by_text[text] for text in texts if text in self._by_text), None)

    def check(self, where: Path, term: str, columns: Sequence[str], count: int) -> tuple[str, ...]:
        """Return the columns that a file gives for a term; raises `ArtifactError` if they are not all there."""
        if len(columns) != count:
            raise ArtifactError(f"{where}: {term} has {count} elements, and {len(columns)} columns are given")
        for column in columns:
            check_name(column, self._names, f"{where}: {term}: {self._path} has no column", ArtifactError)
        return tuple(columns)

    def find_indexed(self, texts: Sequence[str], count: int) -> tuple[str, ...] | None:
        """Return the columns TEXT_0 to TEXT_n-1, or TEXT_1 to TEXT_n, of which there are exactly `count`."""
        for text in texts:
            for first in (0, 1):
                keys = [f"{text}_{index}" for index in range(first, first + count)]
                beyond = f"{text}_{first + count}"
                if all(key in self._by_text for key in keys) and beyond not in self._by_text:
                    return tuple(self._by_text[key] for key in keys)
        return None

    def find_joints(self, term: str) -> tuple[str, ...]:
        """Return the joints of which a term has a column, by their names."""
        texts = (term, term.removesuffix("s"), *_SYNONYMS.get(term, ()))
        return tuple(
            joint for joint in self._joints if any(f"{text}_{_simplify(joint)}" in self._by_text for text in texts)
        )

    def find(self, term: str, count: int) -> tuple[str, ...]:
        """Return the columns of a term; raises `ArtifactError` if they cannot be decided."""
        own = (term, term.removesuffix("s")) if term == ACTIONS else (term,)
        for text in (*own, *_SYNONYMS.get(term, ())):
            if (columns := self._find_by_text(text, count)) is not None:
                if text not in own:
                    self.notes.append(f"{term}: columns {columns[0]} to {columns[-1]}")
                return columns
        return self._find_closest(term, count)

    def _find_by_text(self, text: str, count: int) -> tuple[str, ...] | None:
        if count == 1 and text in self._by_text:
            return (self._by_text[text],)
        if (columns := self.find_indexed((text,), count)) is not None:
            return columns
        suffixes = [*_SUFFIXES.get(count, ())]
        if self._joints and len(self._joints) == count:
            own = tuple(_simplify(joint) for joint in self._joints)
            suffixes += [own, tuple(f"{joint}_pos" for joint in own)]  # LeRobot's names of joints
        for some in suffixes:
            if all(f"{text}_{suffix}" in self._by_text for suffix in some):
                return tuple(self._by_text[f"{text}_{suffix}"] for suffix in some)
        return None

    def find_exact(self, term: str, count: int) -> tuple[str, ...] | None:
        """Return the columns with exactly the name of a term; None if they are not there."""
        return self._find_by_text(_simplify(term), count)

    def _find_closest(self, term: str, count: int) -> tuple[str, ...]:
        groups = {re.sub(r"_\d+$", "", text) for text in self._by_text}
        alike = {
            group: columns
            for group in groups
            if difflib.SequenceMatcher(None, group, term).ratio() >= _CLOSE
            and (columns := self._find_by_text(group, count)) is not None
        }
        if len(alike) == 1:
            columns = next(iter(alike.values()))
            self.notes.append(f"{term}: columns {columns[0]} to {columns[-1]}, whose name is the closest")
            return columns
        self._refuse_incomplete(term, count)
        known = ", ".join(self._names[:8]) + (", ..." if len(self._names) > 8 else "")
        if alike:
            raise ArtifactError(
                f"{self._path}: {term} could be {' or '.join(sorted(alike))}; say which: --columns FILE"
            )
        raise ArtifactError(
            f"{self._path}: no {count} columns for {term}, such as {term}_0 to {term}_{count - 1}; it has {known}\n"
            "give the columns' names: --columns FILE"
        )

    def _refuse_incomplete(self, term: str, count: int) -> None:
        """Raise `ArtifactError` if a log has some of the columns of a term."""
        for text in (term, term.removesuffix("s"), *_SYNONYMS.get(term, ())):
            present = [index for index in range(count + 1) if f"{text}_{index}" in self._by_text]
            if len(present) < 2:
                continue
            wanted = range(count) if 0 in present else range(1, count + 1)
            missing = [f"{text}_{index}" for index in wanted if index not in present]
            if missing:
                raise ArtifactError(
                    f"{self._path}: {term} has {count} elements, and columns are missing: {', '.join(missing)}\n"
                    "give the columns' names: --columns FILE"
                )
            extra = [name for name in self._names if re.fullmatch(rf"{text}_\d+", _simplify(name))]
            raise ArtifactError(
                f"{self._path}: {term} has {count} elements, and there are {len(extra)} columns, "
                f"{extra[0]} to {extra[-1]}\ngive the columns' names: --columns FILE"
            )
