"""A teacher in a worker: says what it would do in each step that a student plays."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import format_space
from rlctl.environments.teacher_view import TeacherView, find_teacher_view
from rlctl.environments.wrappers import NAME as TIME_LEFT
from rlctl.errors import ArtifactError
from rlctl.play import messages
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.numpy_policy import load_policy
from rlctl.policy.players.named import ExportedPlayer
from rlctl.policy.players.player import Exploration
from rlctl.policy.rows import RowsPolicy
from rlctl.task.batch_env import BatchEnv

Worlds = NDArray[np.int64]


class EpisodeTeacher:
    """The teacher of one environment, which was made with its `TeacherView`."""

    def __init__(self, teacher: messages.LabellingPolicy, env: Any) -> None:
        self._view = find_teacher_view(env)
        self._player = ExportedPlayer(teacher.policy)

    def act(self, seed: int, step: int) -> NDArray[Any]:
        """Return its deterministic action in the present step; call it at every step of an episode, from 0."""
        return np.asarray(self._player.act(self._view.seen, seed, step)[1])


class BatchTeacher:
    """The teacher of the worlds of a `BatchEnv`: one pass for all rows, or a player per world."""

    def __init__(self, teacher: messages.LabellingPolicy, env: BatchEnv) -> None:
        self._env = env
        path = Path(teacher.policy)
        policy = None if path.suffix == ".onnx" else PolicyFile.read(path)
        is_rowwise = policy is not None and RowsPolicy.supports(policy)
        self._rows = RowsPolicy(policy, env.worlds) if policy is not None and is_rowwise else None
        self._single = [] if is_rowwise else [ExportedPlayer(teacher.policy) for _ in range(env.worlds)]
        if self._rows is not None:
            self._rows.begin_segment()

    def act(self, seeds: Worlds, worlds: Worlds) -> NDArray[Any]:
        """Return its deterministic actions in the present step of some worlds, shape (k, ...)."""
        seen, steps = self._env.for_teacher[worlds], self._env.step_of[worlds]
        if self._rows is not None:
            return self._rows.act(seen, seeds, steps, worlds, Exploration())[1]
        players = [self._single[world] for world in worlds.tolist()]
        rows = zip(players, seen, seeds.tolist(), steps.tolist(), strict=True)
        return np.stack([player.act(observation, seed, step)[1] for player, observation, seed, step in rows])


def check_teacher(teacher: messages.LabellingPolicy, env: Any) -> None:
    """Raise `ArtifactError` if a teacher does not fit what an environment shows it."""
    view, info = find_teacher_view(env), load_policy(Path(teacher.policy)).info
    observation_space, action_space = info.env.spaces()
    pairs = ("observation", observation_space, view.teacher_space), ("action", action_space, env.action_space)
    for what, own, given in pairs:
        if own != given:
            spaces = f"its {what} space is {format_space(own, 120)}, the environment's is {format_space(given, 120)}"
            raise ArtifactError(f"{teacher.policy}: this teacher is not for this task: {spaces}")
    if problem := _compare_names(info, view):
        raise ArtifactError(f"{teacher.policy}: this teacher is not for this task: {problem}")


def _compare_names(info: PolicyInfo, view: TeacherView) -> str:
    own, given = [name for name in info.env.observation_sizes if name != TIME_LEFT], list(view.sizes)
    if not own or not given or own == given:
        return ""
    return f"it observes {', '.join(own)}, the environment shows {', '.join(given)}"
