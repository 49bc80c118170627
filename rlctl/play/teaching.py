"""A teacher in a worker: says what it would do in each step that a student plays."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import format_space, take_row
from rlctl.environments.wrappers import NAME as TIME_LEFT
from rlctl.errors import ArtifactError
from rlctl.play import messages
from rlctl.play.playing import Rows
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.numpy_policy import load_policy
from rlctl.policy.players.named import ExportedPlayer
from rlctl.policy.players.player import Exploration
from rlctl.policy.rows import RowsPolicy


class Teacher:
    """The teacher of some worlds, which were made with its spec: one pass for all rows, or a player per world."""

    def __init__(self, teacher: messages.LabellingPolicy, worlds: Any, *, lockstep: bool) -> None:
        path = Path(teacher.policy)
        policy = None if path.suffix == ".onnx" else PolicyFile.read(path)
        is_rowwise = lockstep and policy is not None and RowsPolicy.supports(policy)
        self._rows = RowsPolicy(policy, worlds.count) if policy is not None and is_rowwise else None
        self._single = [] if is_rowwise else [ExportedPlayer(teacher.policy) for _ in range(worlds.count)]
        if self._rows is not None:
            self._rows.begin_segment()

    def act(self, worlds: Any, rows: Rows) -> NDArray[Any]:
        """Return its deterministic actions in the present step of some worlds, shape (k, ...).

        Call it at every step of an episode, from 0.
        """
        seen = worlds.teacher_sees(rows.index)
        if self._rows is not None:
            return self._rows.act(seen, rows.seed, rows.step, rows.index, Exploration())[1]
        return np.stack(
            [
                self._single[world].act(take_row(seen, k), seed, step)[1]
                for k, (world, seed, step) in enumerate(rows.listed)
            ]
        )


def check_teacher(teacher: messages.LabellingPolicy, worlds: Any) -> None:
    """Raise `ArtifactError` if a teacher does not fit what worlds show it."""
    info = load_policy(Path(teacher.policy)).info
    observation_space, action_space = info.env.spaces()
    pairs = ("observation", observation_space, worlds.teacher_space), ("action", action_space, worlds.action_space)
    for what, own, given in pairs:
        if own != given:
            spaces = f"its {what} space is {format_space(own, 120)}, the environment's is {format_space(given, 120)}"
            raise ArtifactError(f"{teacher.policy}: this teacher is not for this task: {spaces}")
    if problem := _compare_names(info, worlds.teacher_sizes):
        raise ArtifactError(f"{teacher.policy}: this teacher is not for this task: {problem}")


def _compare_names(info: PolicyInfo, sizes: Mapping[str, int]) -> str:
    own, given = [name for name in info.env.observation_sizes if name != TIME_LEFT], list(sizes)
    if not own or not given or own == given:
        return ""
    return f"it observes {', '.join(own)}, the environment shows {', '.join(given)}"
