"""A few pictures of a recorded episode, drawn on the CPU: for reports."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ArtifactError
from rlctl.replay.difference import find_difference
from rlctl.replay.recorder import play_episode, recorded_actions
from rlctl.replay.scene import encode_jpeg
from rlctl.run.episode import RecordedEpisode
from rlctl.task.body import Body
from rlctl.task.bullet import pybullet
from rlctl.task.env import TaskEnv
from rlctl.task.sim import Sim

Env = gymnasium.Env[Any, Any]

_WIDTH, _HEIGHT = 240, 180  # [pixels]
_DISTANCE = 1.2  # from the robot to the camera, in sizes of the robot
_DIRECTION = np.array([0.62, -0.68, 0.4])
_NEAREST, _FARTHEST = 0.8, 6.0  # [m]


def take_pictures(episode: RecordedEpisode, count: int) -> list[tuple[int, bytes]]:
    """Play an episode again and return `count` steps of it, the first and the last among them, as JPEG files.

    The camera follows the robot. Raises `TaskError` if the environment fails, `UsageError` if it cannot draw, and
    `ArtifactError` if it does something else than when it was recorded.
    """
    spec, steps = episode.info.spec, len(episode.actions)
    chosen = {int(step) for step in np.linspace(0, steps, count)} - {steps}
    pictures: list[tuple[int, bytes]] = []
    env = spec.make("rgb_array")
    try:
        recorded = recorded_actions(episode, env)

        def choose(observation: Any, step: int) -> Any:
            if step in chosen:
                pictures.append((step, encode_jpeg(_draw(env))))
            return recorded(observation, step)

        rollout = play_episode(env, spec, episode.info.seed, choose, policy=episode.info.policy)
        pictures.append((steps, encode_jpeg(_draw(env))))
    finally:
        env.close()
    if difference := find_difference(episode, rollout):
        raise ArtifactError(f"played again, the episode is another one; {difference}")
    return pictures


def _draw(env: Env) -> NDArray[np.uint8]:
    picture = np.asarray(env.render())  # of a task, it moves the markers too
    inner = env.unwrapped
    robots = [body for body in inner.sim.bodies.values() if body.joint_names] if isinstance(inner, TaskEnv) else []
    return _draw_robot(inner.sim, robots[0]) if isinstance(inner, TaskEnv) and robots else picture


def _draw_robot(sim: Sim, robot: Body) -> NDArray[np.uint8]:
    links = range(-1, len(robot.link_names))
    boxes = np.array([pybullet.getAABB(robot.id, link, physicsClientId=sim.client) for link in links])
    # A link without a shape has an empty box.
    boxes = boxes[(boxes[:, 1] - boxes[:, 0]).max(axis=1) > 1e-3]
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    center, distance = (low + high) / 2, _DISTANCE * float(np.linalg.norm(high - low))
    eye = center + np.clip(distance, _NEAREST, _FARTHEST) * _DIRECTION
    return sim.render(_WIDTH, _HEIGHT, eye=eye.tolist(), target=center.tolist())
