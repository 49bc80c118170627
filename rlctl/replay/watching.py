"""Living an episode while watching it: the world of a task, the camera of any other environment."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator

from rlctl import registry
from rlctl.env_spec import EnvSpec
from rlctl.errors import RlctlError
from rlctl.replay.live import Choose, Env, Lived, live
from rlctl.replay.pictures import Camera
from rlctl.replay.scene import Scene, SceneObserver
from rlctl.task.env import TaskEnv

Tell = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Watched:
    """An episode, and what was seen of it."""

    lived: Lived
    scene: Scene | None = None
    pictures: list[tuple[int, bytes]] = dataclasses.field(default_factory=list)
    """Step and JPEG file."""


@contextlib.contextmanager
def watched_env(spec: EnvSpec, tell: Tell) -> Iterator[Env]:
    """Build an environment to watch, and close it; `tell` hears why there will be no pictures."""
    env = _build(spec, tell)
    try:
        yield env
    finally:
        env.close()


def _build(spec: EnvSpec, tell: Tell) -> Env:
    if registry.is_task(spec.constructor()):
        return spec.make()  # its bodies are drawn; pictures would be slow and say less
    try:
        return spec.make("rgb_array")
    except RlctlError as error:
        env = spec.make()  # raises again if drawing was not the reason
        tell(f"no camera pictures: {str(error).splitlines()[0]}")
        return env


def watch(env: Env, spec: EnvSpec, seed: int, choose: Choose, *, policy: str, tell: Tell) -> Watched:
    """Live an episode and keep what can be drawn of it."""
    inner = env.unwrapped
    if isinstance(inner, TaskEnv):
        observer = SceneObserver(inner)
        lived = live(env, spec, seed, choose, policy=policy, observers=[observer])
        return Watched(lived, scene=observer.scene())
    camera = Camera(env, tell)
    lived = live(env, spec, seed, choose, policy=policy, observers=[camera])
    return Watched(lived, pictures=camera.pictures)
