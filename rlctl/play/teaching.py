"""Whether a teacher, which says what it would do in each step that a student plays, fits the task."""

from collections.abc import Mapping
from pathlib import Path

from rlctl.environments.dict_spaces import format_space
from rlctl.environments.wrappers import NAME as TIME_LEFT
from rlctl.errors import ArtifactError
from rlctl.play import messages
from rlctl.play.playing import Worlds
from rlctl.policy.file import PolicyInfo
from rlctl.policy.load import load_policy


def check_teacher(teacher: messages.LabellingPolicy, worlds: Worlds) -> None:
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
