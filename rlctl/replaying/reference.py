"""Shows the clip that a task follows: its bodies are placed after every step of the physics."""

from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.replaying.scene import Env
from rlctl.task.batch import BatchTask
from rlctl.task.env import TaskEnv

REFERENCE = "reference"
"""The policy that shows a clip."""


def check_has_reference(spec: EnvSpec) -> None:
    """Raise `UsageError` for a task that follows no clip."""
    cls = spec.constructor()
    place = cls.place_reference if isinstance(cls, type) and issubclass(cls, BatchTask) else None
    if place is None or place is BatchTask.place_reference:
        raise UsageError(
            f"--policy {REFERENCE}: {spec.task} follows no clip; rlctl tasks new NAME --model FILE --motion CLIP "
            "makes a task that does, and a BatchTask of your own needs place_reference()"
        )


def show_reference(env: Env) -> None:
    """Place the bodies of a task after every step where its clip has them."""
    inner = env.unwrapped
    assert isinstance(inner, TaskEnv)
    task = inner.worlds.task
    assert isinstance(task, BatchTask)
    inner.worlds.after_physics = task.place_reference
